"""Run what is missing of an experiment; what is there already is kept."""

import shlex
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.cells import Cell, cells_of, demo_config
from rgbavatar_ns.experiments.commands import killed_by
from rgbavatar_ns.experiments.dataset_state import dataset_state
from rgbavatar_ns.experiments.engines import Engine
from rgbavatar_ns.experiments.kept import kept_results, portable_keys
from rgbavatar_ns.experiments.overrides import check_overrides, check_together, with_overrides
from rgbavatar_ns.experiments.process_lock import alone_in_sweep
from rgbavatar_ns.experiments.reenactment import load_tracker
from rgbavatar_ns.experiments.runner import (
    FAILED_FILE,
    LOG_FILE,
    RESULT_FILE,
    is_of_other_data,
    read_result,
    write_cell,
)
from rgbavatar_ns.experiments.source import keep_source
from rgbavatar_ns.experiments.spec import Experiment, nearest
from rgbavatar_ns.files import DiskError, atomic_folder, disk_errors, read_json, write_json
from rgbavatar_ns.reading import DamagedFileError, damage_told, load_json
from rgbavatar_ns.synthetic import make_demo_dataset

State = Literal["waiting", "running", "done", "failed"]
_ATTEMPTS = 2
_LAST_LINES = 8


@dataclass
class CellStatus:
    """Where a cell stands; `why` is the end of a failed one's log."""

    cell: Cell
    folder: Path
    state: State
    result: dict[str, Any] | None = None
    why: list[str] = field(default_factory=list)

    @property
    def shown_state(self) -> State:
        """As `state`; of the cells that are given to the engine those are running that began."""
        waits = self.state == "running" and not (self.folder / LOG_FILE).exists()
        return "waiting" if waits else self.state


def check_experiment(experiment: Experiment) -> None:
    """Raise UserError where the preset or an override does not exist, fit or lie in its range."""
    # Loads nerfstudio, which takes seconds.
    from rgbavatar_ns.plugin.presets import presets
    from rgbavatar_ns.plugin.training.ranges import require_in_range

    known = presets()
    tracker = (experiment.cross_identity or {}).get("tracker")
    if tracker is not None:
        load_tracker(tracker)
    for variant in experiment.variants:
        where = f"The experiment {experiment.name}, variant {variant.name!r},"
        preset = variant.preset or experiment.preset
        if preset not in known:
            named = where if variant.preset else f"The experiment {experiment.name}"
            raise UserError(f"{named} names the preset {preset!r}.", nearest(preset, list(known)))
        base = f"The experiment {experiment.name}, base,"
        check_overrides(known[preset], experiment.base, base)
        check_overrides(known[preset], variant.overrides, where)
        config = with_overrides(known[preset], {**experiment.base, **variant.overrides})
        try:
            require_in_range(config)
            check_together(config)
        except UserError as error:
            raise UserError(f"{where} cannot be trained: {error.cause}", error.remedy) from None


def sweep(
    experiment: Experiment,
    folder: Path,
    engine: Engine,
    progress: Callable[[Sequence[CellStatus]], None] = lambda statuses: None,
    *,
    known: Sequence[Path] = (),
    variants: Sequence[str] = (),
    making: Callable[[str, int, int], None] = lambda subject, done, total: None,
) -> list[CellStatus]:
    """Train and evaluate every cell that has no result yet, and return where all stand.

    With `variants` only the cells of rows with these names, in the file's order; the others are
    left for another call.

    `progress` is called whenever that changes, `making` with a procedural subject and how many of
    its frames are drawn.
    A cell lives in `folder/cells/HASH`; a second call does only what is missing and resumes what
    was interrupted. Cells whose results `known` holds, files of `report --into`, are done too: such
    a file tells a dataset by its name alone. A failed cell is tried once more, then left with the
    last lines of its log (failed.json); the others go on. Raises UserError, before anything runs,
    for what `check_experiment` finds, for a variant that is none, for a dataset that has changed
    since its cells were trained, for a file of `known` that holds no results and while another
    process sweeps into `folder`; and where that cannot be written, such as on a full disk.
    """
    check_experiment(experiment)
    kept = {key: result for path in known for key, result in kept_results(path).items()}
    remedy = "Make room or mend the permissions, then call it again: finished cells are kept."
    try:
        with disk_errors(folder, remedy), alone_in_sweep(folder):
            cells = cells_of(experiment)
            chosen = _chosen(experiment, cells, variants)
            for key, portable in portable_keys(cells).items() if kept else ():
                place = folder / "cells" / key
                if portable in kept and read_result(place) is None:
                    write_json(place / RESULT_FILE, kept[portable])
            return _sweep(experiment, cells, chosen, folder, engine, progress, making)
    except DiskError as error:
        cause = f"The sweep of {experiment.name} cannot go on: {error.cause}"
        raise DiskError(cause, remedy) from error


def _chosen(experiment: Experiment, cells: Sequence[Cell], variants: Sequence[str]) -> list[Cell]:
    """The cells of the rows with these names; all of them where none are given."""
    names = {cell.variant for cell in cells}
    for name in variants:
        if name not in names:
            cause = f"The experiment {experiment.name} has no variant {name!r}."
            raise UserError(cause, nearest(name, names))
    return [cell for cell in cells if not variants or cell.variant in variants]


def _sweep(
    experiment: Experiment,
    cells: Sequence[Cell],
    chosen: Sequence[Cell],
    folder: Path,
    engine: Engine,
    progress: Callable[[Sequence[CellStatus]], None],
    making: Callable[[str, int, int], None],
) -> list[CellStatus]:
    side_by_side, state = engine.side_by_side, cache(dataset_state)
    statuses = [_status(cell, folder) for cell in cells]
    _require_same_data(statuses, folder, state)
    statuses = [status for status in statuses if status.cell in chosen]
    write_json(folder / f"{experiment.name}.json", [cell.to_json() for cell in cells])
    keep_source(folder, experiment)
    progress(statuses)
    # All variants of one subject first, so that there is a comparison before the next begins.
    seeds, subjects = experiment.seeds, list(dict.fromkeys(cell.subject for cell in cells))
    by_subject = sorted(
        statuses, key=lambda s: (seeds.index(s.cell.seed), subjects.index(s.cell.subject))
    )
    missing = {status.folder: status for status in by_subject if status.state != "done"}
    needed = [status.cell for status in missing.values()]
    shown = {name for cell in needed for name in (cell.subject, _driver(cell)) if name}
    data = {name: _dataset(name, folder, making) for name in sorted(shown)}
    state = cache(dataset_state)  # as they are now, some of them only just made
    for status in missing.values():
        status.folder.mkdir(parents=True, exist_ok=True)
        for left in (LOG_FILE, FAILED_FILE):
            (status.folder / left).unlink(missing_ok=True)
        cell, driver = status.cell, data.get(_driver(status.cell))
        place = data[cell.subject]
        write_cell(status.folder, cell, place, driver, side_by_side=side_by_side, state=state)

    def finished(cell_folder: Path, code: int) -> None:
        for status in statuses:  # variants may share a cell
            if status.folder == cell_folder:
                status.result = read_result(cell_folder)
                done = code == 0 and status.result is not None
                status.state = "done" if done else "failed"
                status.why = [] if done else _why(code, cell_folder)
        _keep_failure(cell_folder, statuses)
        progress(statuses)

    for _ in range(_ATTEMPTS):
        left = [path for path, status in missing.items() if status.state != "done"]
        for status in statuses:
            status.state = "running" if status.folder in left else status.state
        progress(statuses)
        if left:
            engine.run(left, finished)
    return statuses


def _keep_failure(cell_folder: Path, statuses: Sequence[CellStatus]) -> None:
    """Leave in a failed cell's folder why, for reports; nothing in one that has a result."""
    (why, *_) = (status.why for status in statuses if status.folder == cell_folder)
    # Of a full disk: what else runs goes on all the same.
    with suppress(OSError, DiskError):
        if why:
            write_json(cell_folder / FAILED_FILE, {"why": why})
        else:
            (cell_folder / FAILED_FILE).unlink(missing_ok=True)


def _why(code: int, cell_folder: Path) -> list[str]:
    """The end of a failed cell's log, and what killed it, if anything did."""
    lines = last_lines(cell_folder / LOG_FILE, _LAST_LINES)
    if code < 0:
        return [*lines, f"The cell was {killed_by(code)}."]
    return lines or [f"The cell ended with exit code {code} and said nothing."]


def last_lines(path: Path, count: int) -> list[str]:
    """The end of a log, without blank lines; reads at most its last 64 KiB."""
    try:
        with path.open("rb") as log:
            log.seek(max(0, path.stat().st_size - (1 << 16)))
            text = log.read().decode(errors="replace")
    except OSError as error:
        return [f"(no log: {error})"]
    return [line.rstrip() for line in text.splitlines() if line.strip()][-count:]


def read_statuses(folder: Path, name: str) -> list[CellStatus]:
    """Where the cells of an experiment stand in `folder`; UserError if it never ran there."""
    try:
        with damage_told():
            listed = load_json(folder / f"{name}.json")
            statuses = [_status(Cell.from_json(values), folder) for values in listed]
    except DamagedFileError as error:
        raise UserError(
            f"The sweep of {name} was not begun in {folder}, or its list of cells there is another "
            f"version's or damaged ({error}).",
            "Run `rgbavatar sweep FILE` with this folder first.",
        ) from None
    for status in statuses:
        failure = read_json(status.folder / FAILED_FILE) if status.result is None else None
        if isinstance(failure, dict):
            status.state, status.why = "failed", list(map(str, failure.get("why", ())))
    return statuses


def _status(cell: Cell, folder: Path) -> CellStatus:
    cell_folder = folder / "cells" / cell.key
    result = read_result(cell_folder)
    return CellStatus(cell, cell_folder, "waiting" if result is None else "done", result)


def _driver(cell: Cell) -> str:
    return "" if cell.cross_identity is None else cell.cross_identity["driver"]


def _require_same_data(
    statuses: Sequence[CellStatus], folder: Path, state: Callable[[Path], str]
) -> None:
    """Raise UserError where a dataset is another than its cells were trained on."""
    outdated: dict[Path, str] = {}
    for status in statuses:
        cell = status.cell
        data, driver = _place(cell.subject, folder), _driver(cell)
        driver_data = _place(driver, folder) if driver else None
        there = data.exists() and (driver_data is None or driver_data.exists())
        if there and is_of_other_data(status.folder, data, driver_data, state=state):
            outdated[status.folder] = f"{data} or {driver_data}" if driver_data else str(data)
    if outdated:
        changed = ", ".join(dict.fromkeys(outdated.values()))
        raise UserError(
            f"{changed} has changed since cells were trained on it.",
            "Sweep into another --output, or delete what was trained before: "
            f"{shlex.join(map(str, outdated))}.",
        )


def _place(subject: str, folder: Path) -> Path:
    """Where the subject's dataset lies, or will."""
    config = demo_config(subject)
    if config is None:
        return Path(subject)
    return folder / "data" / f"demo-{config.seed}-{config.num_frames}-{config.image_size}"


def _dataset(subject: str, folder: Path, making: Callable[[str, int, int], None]) -> Path:
    """The subject's dataset; a procedural one is made once, whole or not at all."""
    config, path = demo_config(subject), _place(subject, folder)
    if config is not None and not path.exists():
        with atomic_folder(path) as partial:
            make_demo_dataset(
                partial, config, progress=lambda done, total: making(subject, done, total)
            )
    return path
