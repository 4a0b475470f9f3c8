"""Tables of an experiment: means and spreads over subjects and seeds, the paper's beside them."""

import csv
import io
import math
import statistics
from collections.abc import Sequence
from dataclasses import astuple, dataclass

from rgbavatar_ns.experiments.spec import METRICS, Experiment
from rgbavatar_ns.experiments.sweep import CellStatus

HEADINGS = {metric: heading for metric, (heading, _) in METRICS.items()}
_MISSING = "-"


@dataclass(frozen=True)
class Entry:
    """One figure of the table: mean and standard deviation over `count` cells."""

    mean: float
    spread: float
    count: int


@dataclass(frozen=True)
class Row:
    """A variant: its figures by metric, how many of its cells are done, the cells' keys."""

    name: str
    entries: dict[str, Entry]
    paper: dict[str, float]
    done: int
    cells: tuple[str, ...]


@dataclass(frozen=True)
class ResultTable:
    """All variants of an experiment, in its order."""

    title: str
    metrics: tuple[str, ...]
    rows: tuple[Row, ...]
    paper_heading: str | None
    notes: tuple[str, ...]

    def to_markdown(self) -> str:
        """With the title above and notes below."""
        heading = "| " + " | ".join(self._heading()) + " |"
        rule = "| --- |" + " ---: |" * (len(self._heading()) - 1)
        lines = ["| " + " | ".join(cells) + " |" for cells in self._lines()]
        notes = [f"- {note}" for note in self.notes]
        text = "\n".join([f"### {self.title}", "", heading, rule, *lines, "", *notes])
        return text.rstrip() + "\n"

    def to_csv(self) -> str:
        """Every figure in full precision: mean, spread and count in columns of their own."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        paper = self.metrics if self.paper_heading else ()
        named = [f"{m}_{part}" for m in self.metrics for part in ("mean", "std", "count")]
        writer.writerow(["variant", *named, *(f"paper_{m}" for m in paper), "cells"])
        for row in self.rows:
            entries = [row.entries.get(metric) for metric in self.metrics]
            parts = [part for e in entries for part in (astuple(e) if e else ("", "", ""))]
            published = [row.paper.get(metric, "") for metric in paper]
            writer.writerow([row.name, *parts, *published, " ".join(row.cells)])
        return text.getvalue()

    def to_latex(self) -> str:
        """A booktabs tabular, as the paper's tables."""
        heading = " & ".join(_escaped(cell) for cell in self._heading())
        lines = [" & ".join(_escaped(c) for c in cells) + r" \\" for cells in self._lines()]
        columns = "l|" + "c" * (len(self._heading()) - 1)
        begin = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", heading + r" \\", r"\midrule"]
        return "\n".join([*begin, *lines, r"\bottomrule", r"\end{tabular}", ""])

    def _heading(self) -> list[str]:
        ours = [HEADINGS[metric] for metric in self.metrics]
        if self.paper_heading is None:
            return ["Method", *ours]
        return ["Method", *ours, *(f"{name}, {self.paper_heading}" for name in ours)]

    def _lines(self) -> list[list[str]]:
        lines = []
        for row in self.rows:
            cells = [_told(metric, row.entries.get(metric)) for metric in self.metrics]
            if self.paper_heading is not None:
                cells += [_number(metric, row.paper.get(metric)) for metric in self.metrics]
            lines.append([row.name, *cells])
        return lines


def result_table(experiment: Experiment, statuses: Sequence[CellStatus]) -> ResultTable:
    """The table of what is done; notes say what is missing and why a metric is not available."""
    rows = []
    for variant in experiment.variants:
        mine = [status for status in statuses if status.cell.variant == variant.name]
        done = [status.result for status in mine if status.result is not None]
        entries = {
            metric: _entry([result["metrics"][metric] for result in done])
            for metric in experiment.metrics
            if done and all(metric in result["metrics"] for result in done)
        }
        keys = tuple(status.cell.key for status in mine if status.result is not None)
        rows.append(Row(variant.name, entries, dict(variant.paper), len(done), keys))
    heading = None
    if any(row.paper for row in rows):
        heading = "paper" + (f" ({experiment.paper_data})" if experiment.paper_data else "")
    return ResultTable(
        experiment.title, experiment.metrics, tuple(rows), heading, _notes(experiment, statuses)
    )


def _notes(experiment: Experiment, statuses: Sequence[CellStatus]) -> tuple[str, ...]:
    done = [status for status in statuses if status.result is not None]
    subjects = ", ".join(sorted({status.cell.subject.rsplit("/", 1)[-1] for status in statuses}))
    seeds = ", ".join(str(seed) for seed in experiment.seeds)
    notes = [
        f"{len(done)} of {len(statuses)} cells done; preset {experiment.preset}; "
        f"subjects {subjects}; seeds {seeds}; ± is the standard deviation over them."
    ]
    unavailable: dict[str, str] = {}
    for status in done:
        unavailable.update((status.result or {}).get("unavailable", {}))
    notes += [
        f"{HEADINGS[metric]} is not available: {reason}"
        for metric, reason in sorted(unavailable.items())
        if metric in experiment.metrics
    ]
    failed = sorted({status.cell.variant for status in statuses if status.state == "failed"})
    return (*notes, *(f"{name}: a cell failed, see its log." for name in failed))


def _entry(values: Sequence[float]) -> Entry:
    spread = statistics.stdev(values) if len(values) > 1 else 0.0
    return Entry(statistics.fmean(values), spread, len(values))


def _told(metric: str, entry: Entry | None) -> str:
    if entry is None:
        return _MISSING
    mean = _number(metric, entry.mean)
    return f"{mean} ± {_number(metric, entry.spread)}" if entry.count > 1 else mean


def _number(metric: str, value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return _MISSING
    _, digits = METRICS[metric]
    return f"{value:.1e}" if 0 < abs(value) < 10.0**-digits else f"{value:.{digits}f}"


def _escaped(text: str) -> str:
    for symbol in "&%$#_{}":
        text = text.replace(symbol, "\\" + symbol)
    return text.replace("±", r"$\pm$")
