"""Tables of an experiment: by variant and by subject, the paper's figures beside them."""

import csv
import io
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any

from rgbavatar_ns.experiments.cells import Cell
from rgbavatar_ns.experiments.columns import COLUMNS
from rgbavatar_ns.experiments.runner import SIDE_BY_SIDE
from rgbavatar_ns.experiments.spec import Experiment, Variant, subject_name
from rgbavatar_ns.experiments.sweep import CellStatus

_MISSING = "-"
_ENDS_BY_SECONDS = "max_train_seconds"
_STREAMED = "l1_streamed"
_SAID_ABOVE, _ERROR = "its last lines above say why", "Error: "
"""How `commands.run_nerfstudio` ends where its command failed, and how that began to say why."""
_LONGEST_REASON = 300


@dataclass(frozen=True)
class Entry:
    """One figure of the table: the mean over `count` cells, and how far seeds part from it.

    `spread` is the standard deviation over seeds of the means over subjects, which part by their
    nature; None where there is one seed.
    """

    mean: float | None
    """None where it is not finite."""
    spread: float | None
    count: int


@dataclass(frozen=True)
class Row:
    """A variant: its figures by metric, and the keys of the cells that are done.

    Over all subjects and seeds, or over the seeds of one `subject`. Where not all cells are done,
    its means are over fewer of them than other rows' may be, and its name says so.
    """

    name: str
    entries: dict[str, Entry]
    paper: dict[str, float]
    cells: tuple[str, ...]
    subject: str = ""
    planned: int | None = None
    """How many cells there are to be; None in tables of before."""

    @property
    def shown_name(self) -> str:
        """With how many of its cells are done, where that is not all."""
        if self.planned is None or len(self.cells) == self.planned:
            return self.name
        return f"{self.name} ({len(self.cells)} of {self.planned} cells)"


@dataclass(frozen=True)
class ResultTable:
    """All variants of an experiment, in its order."""

    title: str
    metrics: tuple[str, ...]
    rows: tuple[Row, ...]
    paper_heading: str | None
    notes: tuple[str, ...]
    subject_rows: tuple[Row, ...] = ()
    """The same for each subject by itself, subject after subject; none where there is one."""

    def to_markdown(self) -> str:
        """With the title above and notes below, then the subjects' table."""
        return f"### {self.title}\n\n{self.body_markdown()}"

    def body_markdown(self) -> str:
        """`to_markdown` without the title."""
        notes = [f"- {note}" for note in self.notes]
        lines = [*_markdown(self.heading(), self.lines()), "", *notes]
        if self.subject_rows:
            lines += ["", "By subject:", ""]
            lines += _markdown(self.heading(by_subject=True), self.lines(by_subject=True))
        return "\n".join(lines).rstrip() + "\n"

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "ResultTable":
        """Build from `dataclasses.asdict` as JSON keeps it.

        Raises KeyError or TypeError where the values are not of that form.
        """
        rows, subject_rows = (
            tuple(_row_from_json(row) for row in values[part]) for part in ("rows", "subject_rows")
        )
        return cls(
            values["title"],
            tuple(values["metrics"]),
            rows,
            values["paper_heading"],
            tuple(values["notes"]),
            subject_rows,
        )

    @property
    def published(self) -> tuple[str, ...]:
        """The metrics that the paper has a figure of."""
        rows = (*self.rows, *self.subject_rows)
        return tuple(m for m in self.metrics if any(m in row.paper for row in rows))

    def to_csv(self) -> str:
        """Every figure in full precision: mean, spread and count in columns of their own.

        The column `subject` is empty where a row is over all of them; `planned` cells are all that
        there are to be.
        """
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        paper = self.metrics if self.paper_heading else ()
        named = [f"{m}_{part}" for m in self.metrics for part in ("mean", "std", "count")]
        published = [f"paper_{metric}" for metric in paper]
        writer.writerow(["variant", "subject", *named, *published, "planned", "cells"])
        for row in (*self.rows, *self.subject_rows):
            entries = [row.entries.get(metric) for metric in self.metrics]
            parts = [part for e in entries for part in (astuple(e) if e else ("", "", ""))]
            theirs = [row.paper.get(metric, "") for metric in paper]
            cells = [row.planned, " ".join(row.cells)]
            writer.writerow([row.name, row.subject, *parts, *theirs, *cells])
        return text.getvalue()

    def to_latex(self) -> str:
        """A booktabs tabular, as the paper's tables; a second one by subject."""
        text = _latex(self.heading(), self.lines())
        if self.subject_rows:
            text += "\n" + _latex(self.heading(by_subject=True), self.lines(by_subject=True))
        return text

    def heading(self, *, by_subject: bool = False) -> list[str]:
        """What stands above the columns."""
        ours = [COLUMNS[metric].heading for metric in self.metrics]
        first = ["Subject", "Method"] if by_subject else ["Method"]
        if self.paper_heading is None:
            return [*first, *ours]
        theirs = [f"{COLUMNS[metric].heading}, {self.paper_heading}" for metric in self.published]
        return [*first, *ours, *theirs]

    def lines(self, *, by_subject: bool = False) -> list[list[str]]:
        """The table's cells as texts, row by row."""
        lines = []
        for row in self.subject_rows if by_subject else self.rows:
            cells = [_told(metric, row.entries.get(metric)) for metric in self.metrics]
            if self.paper_heading is not None:
                cells += [_number(metric, row.paper.get(metric)) for metric in self.published]
            first = [row.subject] if by_subject else []
            lines.append([*first, row.shown_name, *cells])
        return lines


def _row_from_json(values: Mapping[str, Any]) -> Row:
    entries = {metric: Entry(**entry) for metric, entry in values["entries"].items()}
    return Row(**{**values, "entries": entries, "cells": tuple(values["cells"])})


def _markdown(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    texts = sum(name in ("Subject", "Method") for name in heading)
    rule = "|" + " --- |" * texts + " ---: |" * (len(heading) - texts)
    return ["| " + " | ".join(heading) + " |", rule, *("| " + " | ".join(c) + " |" for c in lines)]


def _latex(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    texts = sum(name in ("Subject", "Method") for name in heading)
    columns = "l" * texts + "|" + "c" * (len(heading) - texts)
    above = " & ".join(map(_escaped, heading)) + r" \\"
    rows = [" & ".join(map(_escaped, cells)) + r" \\" for cells in lines]
    begin = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", above, r"\midrule"]
    return "\n".join([*begin, *rows, r"\bottomrule", r"\end{tabular}", ""])


def result_table(experiment: Experiment, statuses: Sequence[CellStatus]) -> ResultTable:
    """The table of what is done; notes say what is missing and why a metric is not available."""
    named = _subject_names(statuses)
    rows = tuple(
        _row(experiment, variant, statuses, _published(variant, list(named.values())))
        for variant in experiment.variants
    )
    subject_rows = tuple(
        _row(
            experiment,
            variant,
            [status for status in statuses if status.cell.subject == subject],
            dict(variant.paper_by_subject.get(name, {})),
            name,
        )
        for subject, name in named.items()
        for variant in experiment.variants
        if len(named) > 1
    )
    heading = None
    if any(row.paper for row in (*rows, *subject_rows)):
        heading = "paper" + (f" ({experiment.paper_data})" if experiment.paper_data else "")
    notes = _notes(experiment, statuses, named)
    return ResultTable(experiment.title, experiment.metrics, rows, heading, notes, subject_rows)


def _row(
    experiment: Experiment,
    variant: Variant,
    statuses: Sequence[CellStatus],
    paper: dict[str, float],
    subject: str = "",
) -> Row:
    mine = [status for status in statuses if status.cell.variant == variant.name]
    done = [(status.cell, status.result) for status in mine if status.result is not None]
    entries = {
        metric: _entry([(cell, result["metrics"][metric]) for cell, result in done])
        for metric in experiment.metrics
        if done and all(metric in result["metrics"] for _, result in done)
    }
    keys = tuple(status.cell.key for status in mine if status.result is not None)
    return Row(variant.name, entries, paper, keys, subject, len(mine))


def _subject_names(statuses: Sequence[CellStatus]) -> dict[str, str]:
    """What each subject is called: a folder's name, or its path where two have one name."""
    subjects = list(dict.fromkeys(status.cell.subject for status in statuses))
    short = [subject_name(subject) for subject in subjects]
    return {
        subject: name if short.count(name) == 1 else subject
        for subject, name in zip(subjects, short)
    }


def _published(variant: Variant, subjects: Sequence[str]) -> dict[str, float]:
    """The paper's figures: means over just these subjects where it has them all."""
    known = [variant.paper_by_subject.get(name, {}) for name in subjects]
    means = {
        metric: statistics.fmean(figures[metric] for figures in known)
        for metric in COLUMNS
        if known and all(metric in figures for figures in known)
    }
    return {**variant.paper, **means}


def _notes(
    experiment: Experiment, statuses: Sequence[CellStatus], named: Mapping[str, str]
) -> tuple[str, ...]:
    done = [status for status in statuses if status.result is not None]
    seeds = ", ".join(str(seed) for seed in experiment.seeds)
    notes = [
        f"{len(done)} of {len(statuses)} cells done; preset {experiment.preset}; "
        f"subjects {', '.join(named.values())}; seeds {seeds}"
        + ("; ± is the standard deviation over seeds." if len(experiment.seeds) > 1 else ".")
    ]
    notes += _told_columns(experiment.metrics)
    notes += [
        f"{variant.name}: preset {variant.preset}."
        for variant in experiment.variants
        if variant.preset not in (None, experiment.preset)
    ]
    unavailable: dict[str, str] = {}
    for status in done:
        unavailable.update((status.result or {}).get("unavailable", {}))
    notes += [
        f"{COLUMNS[metric].heading} is not available: {reason}"
        for metric, reason in sorted(unavailable.items())
        if metric in experiment.metrics
    ]
    notes += _told_seconds(experiment, done)
    return (*notes, *_told_failures(experiment, statuses, named))


def _told_seconds(experiment: Experiment, done: Sequence[CellStatus]) -> list[str]:
    """That cells had to share a machine, where the table shows how much they did in a second."""
    beside = [s for s in done if (s.result or {}).get("made", {}).get(SIDE_BY_SIDE)]
    timed = [COLUMNS[metric].heading for metric in experiment.metrics if COLUMNS[metric].timed]
    clocked = any(
        _ENDS_BY_SECONDS in status.cell.overrides or _STREAMED in (status.result or {})["metrics"]
        for status in done
    )
    if not beside or not (timed or clocked):
        return []
    told = f"{len(beside)} of {len(done)} cells may have shared their machine with others: "
    told += f"{', '.join(timed)} are not those of one alone" if timed else ""
    if clocked:
        told += ("; " if timed else "") + "runs that end by the clock took fewer steps for it"
    return [f"{told}."]


def _told_failures(
    experiment: Experiment, statuses: Sequence[CellStatus], named: Mapping[str, str]
) -> list[str]:
    """For each variant with failed cells which these are, and why."""
    notes = []
    for variant in experiment.variants:
        mine = [status for status in statuses if status.cell.variant == variant.name]
        failed = [s for s in mine if s.state == "failed" and s.result is None]
        done = sum(status.result is not None for status in mine)
        causes = "; ".join(
            f"{named[s.cell.subject]}, seed {s.cell.seed}: {_reason(s.why)}" for s in failed
        )
        if failed:
            notes.append(f"{variant.name}: {done} of {len(mine)} cells; failed: {causes}")
    return notes


def _reason(why: Sequence[str]) -> str:
    """The last line of a failed cell's log, or nerfstudio's own error where it refers to that."""
    *above, last = why or ["see its log"]
    if _SAID_ABOVE in last and above:
        errors = [line.removeprefix(_ERROR) for line in above if line.startswith(_ERROR)]
        last = (errors or above)[-1]
    return last[:_LONGEST_REASON]


def _told_columns(metrics: Sequence[str]) -> list[str]:
    """What headings leave open, once for all that leave the same."""
    told: dict[str, list[str]] = {}
    for metric in metrics:
        if COLUMNS[metric].told:
            told.setdefault(COLUMNS[metric].told, []).append(COLUMNS[metric].heading)
    return [f"{'; '.join(headings)}: {words}." for words, headings in told.items()]


def _entry(found: Sequence[tuple[Cell, float]]) -> Entry:
    subjects = {cell.subject for cell, _ in found}
    by_seed: dict[int, dict[str, float]] = {}
    for cell, value in found:
        by_seed.setdefault(cell.seed, {})[cell.subject] = value
    # A seed whose subjects are not all done would part for their sake.
    whole = [statistics.fmean(of.values()) for of in by_seed.values() if of.keys() == subjects]
    # statistics.stdev fails on NaN, as a diverged run leaves it.
    spreads = len(whole) > 1 and all(map(math.isfinite, whole))
    spread = statistics.stdev(whole) if spreads else None
    mean = statistics.fmean(value for _, value in found)
    return Entry(mean if math.isfinite(mean) else None, spread, len(found))


def _told(metric: str, entry: Entry | None) -> str:
    if entry is None:
        return _MISSING
    mean = _number(metric, entry.mean)
    return mean if entry.spread is None else f"{mean} ± {_number(metric, entry.spread)}"


def _number(metric: str, value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return _MISSING
    digits = COLUMNS[metric].digits
    small = digits > 0 and 0 < abs(value) < 10.0**-digits
    return f"{value:.1e}" if small else f"{value:.{digits}f}"


def _escaped(text: str) -> str:
    for symbol in "&%$#_{}":
        text = text.replace(symbol, "\\" + symbol)
    return text.replace("±", r"$\pm$")
