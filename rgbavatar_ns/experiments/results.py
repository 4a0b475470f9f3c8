"""Results for the documentation: JSON with small pictures, and one page drawn from all of them.

A result is named by its experiment. It says by which command, on which machine, at which commit and
when it was made, and nothing of where on that machine.
"""

import math
import re
import shutil
import string
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.cell_pictures import comparison, read_pictures
from rgbavatar_ns.experiments.kept import kept_curve, kept_form, kept_results, portable_keys
from rgbavatar_ns.experiments.plots import (
    convergence,
    write_convergence,
    write_forgetting_curves,
    write_plots,
)
from rgbavatar_ns.experiments.source import Source, read_sources
from rgbavatar_ns.experiments.sweep import CellStatus, read_statuses
from rgbavatar_ns.experiments.tables import ResultTable, result_table
from rgbavatar_ns.files import atomic_write, disk_errors, read_json, write_json

RESULTS, PAGE = "results", "results.md"
_MOST_BYTES = 300_000
_MOST_SHEETS = 3
_DIGITS = 6
_PATH = re.compile(r"(?<![\w:/.])~?/(?:[^\s/'\"]+/)+([^\s/'\"]*)")
"""An absolute path with a folder in it, whose last part is kept; no part of an address."""
_HEAD = """# Results

<!-- `rgbavatar report FOLDER... --into docs` writes this page from results/*.json. -->

Each section is one file of [configs/](../configs/README.md), run by the command below its title.
Scores are of held-out frames. Published figures stand beside ours, not against them: they are of
other data, another tracker and another machine.
"""


def write_results(folder: Path, docs: Path) -> list[Path]:
    """Write or renew what a sweep's folder has to tell as `docs`/results/NAME.json.

    With its curves as PNG, and as JPEG the same held-out frames by each variant, of the first seed
    and up to three subjects, below 300 kB each. Cells that are missing are told. Those that the
    file had and the folder lacks stay in it, with their pictures: a sweep may be made in parts, on
    several machines. Written again from the same folder the files are the same. Returns all paths.
    Raises UserError where nothing was swept there, or matplotlib is missing.
    """
    written: list[Path] = []
    for source in read_sources(folder):
        statuses = read_statuses(folder, source.experiment.name)
        written += _write_result(source, statuses, docs / RESULTS)
    return written


def write_page(docs: Path) -> Path:
    """Write `docs`/results.md from all that lies in `docs`/results, by name.

    Raises UserError for a file there that holds no result.
    """
    paths = sorted((docs / RESULTS).glob("*.json"))
    sections = [_section(path) for path in paths]
    with atomic_write(docs / PAGE) as partial:
        partial.write_text("\n".join([_HEAD, *sections]), encoding="utf-8")
    return docs / PAGE


def _write_result(source: Source, statuses: Sequence[CellStatus], place: Path) -> list[Path]:
    with disk_errors(place):
        place.mkdir(parents=True, exist_ok=True)
    path = place / f"{source.name}.json"
    kept = kept_results(path) if path.exists() else {}
    portable = portable_keys([status.cell for status in statuses])
    for status in statuses:
        if status.result is None:
            status.result = kept.get(portable[status.cell.key])
    title = source.experiment.title + (" (--tiny)" if source.tiny else "")
    table = asdict(result_table(source.experiment, statuses)) | {"title": title}
    before = (read_json(path) or {}).get("drawings", [])
    drawings = _draw_plots(source, statuses, place)
    seen = _draw_what_cells_saw(source, statuses, portable, before, place)
    content = {
        "command": source.command,
        "made": _made(statuses),
        "table": table,
        "cells": {
            portable[status.cell.key]: kept_form(status.cell, status.result, convergence(status))
            for status in statuses
            if status.result is not None
        },
        "drawings": [{"file": drawing.name, "cells": []} for drawing in drawings] + seen,
    }
    write_json(path, _told(content))
    shown = [drawing["file"] for drawing in content["drawings"]]
    for drawing in before:
        if drawing["file"] not in shown:
            (place / Path(drawing["file"]).name).unlink(missing_ok=True)
    return [path, *(place / name for name in shown)]


def _made(statuses: Sequence[CellStatus]) -> dict[str, list[str]]:
    """Machines, versions, commits and days of the finished cells, each once and in order."""
    done = [status.result for status in statuses if status.result is not None]
    # Cells of earlier versions do not say.
    facts = [result["made"] for result in done if "made" in result]
    machines = [
        f"{fact['processor']}, {fact['cores']} cores" + (f", {fact['gpu']}" if fact["gpu"] else "")
        for fact in facts
    ]
    return {
        "machines": sorted(set(machines)),
        "torch": sorted({fact["torch"] for fact in facts}),
        "commits": sorted({fact["commit"] or "not of a checkout" for fact in facts}),
        "days": sorted({fact["date"].split()[0] for fact in facts}),
    }


def _draw_plots(source: Source, statuses: Sequence[CellStatus], place: Path) -> list[Path]:
    """Curves, and metrics where they are against something: between variants the table has them."""
    experiment, name = source.experiment, source.name
    with tempfile.TemporaryDirectory() as made:
        drawn = write_convergence(experiment, statuses, Path(made), name)
        if experiment.plot is not None:
            table = result_table(experiment, statuses)
            drawn += write_plots(experiment, table, Path(made), name)
        with disk_errors(place):
            return [Path(shutil.copyfile(path, place / path.name)) for path in drawn]


def _draw_what_cells_saw(
    source: Source,
    statuses: Sequence[CellStatus],
    portable: Mapping[str, str],
    before: Sequence[Any],
    place: Path,
) -> list[dict[str, Any]]:
    """Pictures and streams' curves: of cells that ran here, and those of `before` of other cells.

    Each with its file's name and the portable keys of the cells that it shows.
    """
    done = [status for status in statuses if status.result is not None]
    here = [status for status in done if kept_curve(status.result or {}) is None]
    elsewhere = {portable[status.cell.key] for status in done if status not in here}
    drawings = [drawing for drawing in before if elsewhere & set(drawing["cells"])]
    taken = {drawing["file"] for drawing in drawings}

    def leave(content: bytes, stem: str, suffix: str, shown: Sequence[CellStatus]) -> None:
        names = (f"{source.name}_{stem}{part}{suffix}" for part in ("", *string.ascii_lowercase))
        path = place / next(name for name in names if name not in taken)
        with atomic_write(path) as partial:
            partial.write_bytes(content)
        keys = [portable[status.cell.key] for status in shown]
        drawings.append({"file": path.name, "cells": keys})

    with tempfile.TemporaryDirectory() as made:
        for path in write_forgetting_curves(here, Path(made), source.name):
            leave(path.read_bytes(), "forgetting", path.suffix, here)
    subjects = list(dict.fromkeys(status.cell.subject for status in statuses))
    for number, subject in enumerate(subjects[:_MOST_SHEETS], start=1):
        one = (subject, source.experiment.seeds[0])
        mine = [status for status in here if (status.cell.subject, status.cell.seed) == one]
        seen = {status.cell.variant: read_pictures(status.folder) for status in mine}
        sheet = comparison({name: found for name, found in seen.items() if found}, _MOST_BYTES)
        if sheet is not None:
            leave(sheet, f"subject{number}", ".jpg", mine)
    return sorted(drawings, key=lambda drawing: drawing["file"])


def _told(value: Any) -> Any:
    """As JSON: numbers of six digits, without this machine's paths."""
    if isinstance(value, dict):
        return {key: _told(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_told(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return _PATH.sub(r"\1", value) if isinstance(value, str) else value


def _section(path: Path) -> str:
    content = read_json(path)
    try:
        table = ResultTable.from_json(content["table"])
        body = table.body_markdown()
        made, command = content["made"], content["command"]
        files = [drawing["file"] for drawing in content["drawings"]]
        when = " to ".join(dict.fromkeys([*made["days"][:1], *made["days"][-1:]]))
        facts = [*made["machines"], *(f"torch {version}" for version in made["torch"])]
        facts += (
            [f"commit {', '.join(made['commits'])}", when] if when else ["machine not recorded"]
        )
    except (TypeError, KeyError, AttributeError):
        raise UserError(
            f"{path} holds no result of this version.",
            "Delete it, or write it again with `rgbavatar report FOLDER --into DOCS`.",
        ) from None
    pictures = "".join(f"\n![{table.title}]({RESULTS}/{name})\n" for name in files)
    return f"## {table.title}\n\n`{command}`  \n{'; '.join(facts)}\n\n{body}{pictures}"
