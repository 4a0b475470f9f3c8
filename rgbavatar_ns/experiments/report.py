"""The report of sweeps: tables as Markdown, CSV and LaTeX, plots, and a page that shows all."""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from rgbavatar_ns.experiments.plots import write_convergence, write_forgetting_curves, write_plots
from rgbavatar_ns.experiments.source import swept_names
from rgbavatar_ns.experiments.spec import Experiment
from rgbavatar_ns.experiments.sweep import CellStatus, read_statuses
from rgbavatar_ns.experiments.tables import ResultTable, Row, result_table
from rgbavatar_ns.files import atomic_write

_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse;margin:1em 0}td,th{padding:.25em .8em;text-align:right;"
    "border-bottom:1px solid #ddd}td:first-child,th:first-child{text-align:left}"
    "img{max-width:100%}code{font-size:85%}.note{color:#666}"
)


@dataclass(frozen=True)
class Report:
    """What was written, and the table itself."""

    table: ResultTable
    statuses: list[CellStatus]
    paths: list[Path]


def write_report(experiment: Experiment, folder: Path, *, plots: bool = True) -> Report:
    """Write NAME.md, .csv, .tex, .png, .svg and index.html into `folder/report`.

    Where other experiments were swept into the folder too, the page is NAME.html, and index.html
    leads to theirs and to this one.

    Every row of the CSV and of the page names its cells; `folder/cells/HASH` holds the run, its
    config and its log. Raises UserError where the sweep was never begun.
    """
    statuses = read_statuses(folder, experiment.name)
    table = result_table(experiment, statuses)
    out = folder / "report"
    texts = {".md": table.to_markdown(), ".csv": table.to_csv(), ".tex": table.to_latex()}
    paths = [out / f"{experiment.name}{suffix}" for suffix in texts]
    for path, text in zip(paths, texts.values()):
        with atomic_write(path) as partial:
            partial.write_text(text, encoding="utf-8")
    drawn = []
    if plots:
        drawn = write_plots(experiment, table, out, experiment.name)
        drawn += write_convergence(experiment, statuses, out, experiment.name)
        drawn += write_forgetting_curves(statuses, out, experiment.name)
    names = sorted({*swept_names(folder), experiment.name})
    text = _page(experiment, table, statuses, drawn)
    pages = {"index.html": text}
    if len(names) > 1:
        there = [n for n in names if n == experiment.name or (out / f"{n}.html").is_file()]
        pages = {f"{experiment.name}.html": text, "index.html": _contents(there)}
    for name, content in pages.items():
        with atomic_write(out / name) as partial:
            partial.write_text(content, encoding="utf-8")
    return Report(table, statuses, [*paths, *drawn, *(out / name for name in pages)])


def _contents(names: Sequence[str]) -> str:
    """A page that leads to each experiment's."""
    links = "".join(
        f'<p><a href="{quote(name)}.html">{html.escape(name)}</a></p>' for name in names
    )
    return _whole_page("Experiments", links)


def _whole_page(title: str, content: str) -> str:
    told = html.escape(title)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{told}</title>'
        f"<style>{_STYLE}</style><h1>{told}</h1>{content}</html>\n"
    )


def _page(
    experiment: Experiment, table: ResultTable, statuses: list[CellStatus], drawn: list[Path]
) -> str:
    tables = _html_table(table, table.rows)
    if table.subject_rows:
        tables += "<h2>By subject</h2>" + _html_table(table, table.subject_rows)
    pictures = "".join(f'<p><img src="{path.name}" alt="plot"></p>' for path in drawn)
    notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in table.notes)
    failed = "".join(
        f"<h3>failed: {html.escape(status.cell.variant)}, seed {status.cell.seed}</h3>"
        f"<pre>{html.escape(chr(10).join(status.why))}</pre>"
        for status in statuses
        if status.state == "failed"
    )
    return _whole_page(experiment.title, f"{tables}{notes}{pictures}{failed}")


def _html_table(table: ResultTable, rows: Sequence[Row]) -> str:
    """Rows with the paper's figures beside them and links to their cells."""
    by_subject = any(row.subject for row in rows)
    heading = [*table.heading(by_subject=by_subject), "cells"]
    lines = []
    for row, cells in zip(rows, table.lines(by_subject=by_subject)):
        links = " ".join(f'<a href="../cells/{key}/">{key[:6]}</a>' for key in row.cells)
        text = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        lines.append(f"<tr>{text}<td><code>{links}</code></td></tr>")
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in heading)
    return f"<table><tr>{head}</tr>{''.join(lines)}</table>"
