"""`rgbavatar sweep`: every cell of an experiment that is not done yet."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rgbavatar_ns.cli.console import command_line, plain_console
from rgbavatar_ns.experiments import read_experiment
from rgbavatar_ns.experiments.engines import Engine, LocalEngine, RayEngine
from rgbavatar_ns.experiments.sweep import CellStatus, sweep
from rgbavatar_ns.options import Between

_STYLE = {"waiting": "dim", "running": "cyan", "done": "green", "failed": "bold red"}
_SECONDS_PER_LINE = 30.0


def run(
    file: Annotated[Path, tyro.conf.Positional],
    output: Path | None = None,
    subjects: tuple[str, ...] | None = None,
    variants: tuple[str, ...] = (),
    tiny: bool = False,
    known: tuple[Path, ...] = (),
    engine: Literal["local", "ray"] = "local",
    at_once: Annotated[int, Between(1, 1024)] = 1,
    address: str | None = None,
    cpus: Annotated[float, Between(0.01, 1e5)] = 2.0,
    gpus: Annotated[float, Between(0, 1e5)] = 0.0,
) -> None:
    """Train and evaluate each variant on each subject with each seed; finished cells are kept.

    Interrupted or failed, call it again: it goes on. `rgbavatar report` makes the tables.

    Args:
        file: the experiment, one of configs/*.yaml or your own.
        output: where everything is written; outputs/sweeps/NAME by default (NAME-tiny with --tiny).
        subjects: in place of the file's: dataset folders, or demo:SEED:FRAMES:SIZE.
        variants: only the rows with these names, as the file has them; another call does the rest.
        tiny: take the file's `tiny` section: minutes on two cores.
        known: files DOCS/results/NAME.json of `rgbavatar report --into DOCS`: their cells are done,
            wherever they ran. Datasets are told apart by their names alone.
        engine: processes of this machine, or a Ray cluster.
        at_once: cells at a time of the local engine. More than one share the machine: their seconds
            are longer, and the report says so.
        address: of the Ray cluster; without it one is started here.
        cpus: CPU cores that a cell asks Ray for.
        gpus: GPUs, or a share of one, that a cell asks Ray for.
    """
    experiment = read_experiment(file, tiny=tiny, subjects=subjects)
    name = f"{experiment.name}-tiny" if tiny else experiment.name
    folder = (output or Path("outputs") / "sweeps" / name).resolve()
    console = plain_console()
    chosen: Engine = LocalEngine(at_once) if engine == "local" else RayEngine(address, cpus, gpus)
    shown = _Progress(console)
    with Live(shown, console=plain_console(soft_wrap=False), refresh_per_second=1):
        statuses = sweep(
            experiment,
            folder,
            chosen,
            shown.cells,
            known=known,
            variants=variants,
            making=shown.subject,
        )
    console.print()
    failed = {status.folder: status for status in statuses if status.state != "done"}
    for status in failed.values():
        console.print("failed:", style="red", end=" ")
        console.print(f"{status.cell.variant}, {status.folder}")
        console.print("\n".join(f"    {line}" for line in status.why))
    options = [*["--tiny"] * tiny, *(["--subjects", *subjects] if subjects else [])]
    report = command_line("rgbavatar", "report", folder, "--file", file, *options)
    console.print(f"{len(statuses) - len(failed)} of {len(statuses)} cells done; {report}")
    if failed:
        sys.exit(1)


class _Progress:
    """The table as it is now; a line for whatever happens where nobody could see it change."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._statuses: Sequence[CellStatus] = ()
        self._told: dict[Path, str] = {}
        self._making = ""
        self._next_line_s = 0.0

    def __rich__(self) -> Group:
        # None before the first cells: an experiment may be refused.
        return Group(_table(self._statuses), self._making) if self._statuses else Group()

    def cells(self, statuses: Sequence[CellStatus]) -> None:
        """Where the cells stand now."""
        self._statuses, self._making = statuses, ""
        ended = {s.folder: s for s in statuses if s.state in ("done", "failed")}
        for folder, status in ended.items():
            if self._told.get(folder) != status.state:
                self._told[folder] = status.state
                cell = status.cell
                name = f"{cell.variant}, {Path(cell.subject).name}, seed {cell.seed}"
                self._line(f"{name}: {status.state} {_score(status)}".rstrip())

    def subject(self, name: str, done: int, total: int) -> None:
        """How far a procedural subject is drawn."""
        self._making = f"drawing {name}: {done} of {total} frames"
        if time.monotonic() >= self._next_line_s or done == total:
            self._next_line_s = time.monotonic() + _SECONDS_PER_LINE
            self._line(self._making)

    def _line(self, text: str) -> None:
        if not self._console.is_terminal:
            self._console.print(text)


def _score(status: CellStatus) -> str:
    score = (status.result or {}).get("metrics", {}).get("psnr")
    return "" if score is None else f"{score:.2f}"


def _table(statuses: Sequence[CellStatus]) -> Table:
    table = Table("variant", "subject", "seed", "state", "PSNR")
    for status in statuses:
        table.add_row(
            status.cell.variant,
            Path(status.cell.subject).name,
            str(status.cell.seed),
            Text(status.shown_state, style=_STYLE[status.shown_state]),
            _score(status),
        )
    return table
