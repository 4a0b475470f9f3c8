"""Results for the documentation: JSON with small pictures, and one page drawn from all of them.

A result is named by its experiment. It says by which command, on which machine, at which commit and
when it was made, and nothing of where on that machine.
"""

import math
import re
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.cell_pictures import comparison, read_pictures
from rgbavatar_ns.experiments.plots import (
    convergence,
    write_convergence,
    write_forgetting_curves,
    write_plots,
)
from rgbavatar_ns.experiments.source import Source, read_sources
from rgbavatar_ns.experiments.spec import subject_name
from rgbavatar_ns.experiments.sweep import CellStatus, read_statuses
from rgbavatar_ns.experiments.tables import ResultTable, result_table
from rgbavatar_ns.files import atomic_write, read_json, write_json

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
    and up to three subjects, below 300 kB each. Cells that are missing are told. Written again from
    the same folder the files are the same. Returns all paths. Raises UserError where nothing was
    swept there, or matplotlib is missing.
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
    place.mkdir(parents=True, exist_ok=True)
    path = place / f"{source.name}.json"
    title = source.experiment.title + (" (--tiny)" if source.tiny else "")
    table = asdict(result_table(source.experiment, statuses)) | {"title": title}
    drawings = [*_draw_plots(source, statuses, place), *_draw_sheets(source, statuses, place)]
    content = {
        "command": source.command,
        "made": _made(statuses),
        "table": table,
        "curves": [
            {
                "variant": status.cell.variant,
                "subject": subject_name(status.cell.subject),
                "seed": status.cell.seed,
                "seconds_psnr": list(points.values()),
            }
            for status in statuses
            if (points := convergence(status))
        ],
        "drawings": [drawing.name for drawing in drawings],
    }
    before = read_json(path) or {}
    write_json(path, _told(content))
    for name in set(before.get("drawings", ())) - set(content["drawings"]):
        (place / Path(name).name).unlink(missing_ok=True)
    return [path, *drawings]


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
        drawn += write_forgetting_curves(statuses, Path(made), name)
        if experiment.plot is not None:
            table = result_table(experiment, statuses)
            drawn += write_plots(experiment, table, Path(made), name)
        return [Path(shutil.copyfile(path, place / path.name)) for path in drawn]


def _draw_sheets(source: Source, statuses: Sequence[CellStatus], place: Path) -> list[Path]:
    seed = source.experiment.seeds[0]
    subjects = list(dict.fromkeys(status.cell.subject for status in statuses))
    sheets = []
    for number, subject in enumerate(subjects[:_MOST_SHEETS], start=1):
        shown = {
            status.cell.variant: found
            for status in statuses
            if (status.cell.subject, status.cell.seed) == (subject, seed)
            and (found := read_pictures(status.folder))
        }
        sheet = comparison(shown, _MOST_BYTES)
        if sheet is not None:
            sheets.append(place / f"{source.name}_subject{number}.jpg")
            with atomic_write(sheets[-1]) as partial:
                partial.write_bytes(sheet)
    return sheets


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
        made, drawings, command = content["made"], content["drawings"], content["command"]
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
    pictures = "".join(f"\n![{table.title}]({RESULTS}/{name})\n" for name in drawings)
    return f"## {table.title}\n\n`{command}`  \n{'; '.join(facts)}\n\n{body}{pictures}"
