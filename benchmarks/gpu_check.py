"""Everything about the CUDA backend on one GPU, in one table, within ten minutes.

    python benchmarks/gpu_check.py --json gpu.json

Run it from a checkout. It needs a driver, torch, numpy, scipy, cuda-bindings, nvidia-cuda-nvrtc,
jaxtyping, safetensors, rich and pytest; neither nerfstudio nor a network. With nvidia-ml-py it also
says how busy the GPU is, with gsplat how much slower that is. `--emulate` asks the questions that
need no GPU of the same kernels, emulated by g++.

The questions are asked in a process of their own, which is started again after one that a kernel
has ended or that takes too long: a failure does not hide the rest.
"""

import argparse
import dataclasses
import importlib
import json
import subprocess
import sys
import tempfile
import time
import traceback
import types
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

SECTIONS = {
    "compile": ("gpu_sections", "compilation"),
    "agreement": ("gpu_sections", "agreement"),
    "step": ("gpu_training", "step_gradients"),
    "lists": ("gpu_lists", "lists"),
    "determinism": ("gpu_training", "determinism"),
    "overflow": ("gpu_training", "overflow"),
    "recorded-overflow": ("gpu_training", "recorded_overflow"),
    "changeover": ("gpu_training", "changeover"),
    "waiting": ("gpu_training", "waiting"),
    "training": ("gpu_training", "training"),
    "rasterizer": ("gpu_timings", "rasterizer"),
    "kernels": ("gpu_timings", "kernels"),
    "steps": ("gpu_timings", "steps"),
    "rendering": ("gpu_timings", "rendering"),
    "gsplat": ("gpu_timings", "gsplat"),
}
EMULATED = ("agreement", "step", "lists", "determinism", "overflow", "changeover", "training")
LIMIT_S = 150
"""Seconds that a section may take, imports included."""
_NO_GPU = 3
_MACHINE = "machine"

Row = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    """Ask, print the table, and return 1 where something is wrong or there is no GPU."""
    options = _options(arguments)
    if options.rows is not None:
        return _ask_all(options)
    console = Console()
    found = _ask_in_processes(options, console)
    if found is None:
        return 1
    machine = found.pop(_MACHINE, {})
    _print(found, machine, console)
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps({_MACHINE: machine, "sections": found}, indent=2))
    return int(any(row["result"] == "FAILED" for row in found.values()))


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--json", type=Path, help="also write all figures here")
    parser.add_argument("--quick", action="store_true", help="fewer cases and repetitions")
    parser.add_argument("--emulate", action="store_true", help="on a CPU; needs g++")
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, metavar="SECTION", help=str([*SECTIONS])
    )
    parser.add_argument("--rows", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    known = EMULATED if options.emulate else tuple(SECTIONS)
    options.only = [name for name in known if name in (options.only or known)]
    return options


def _ask_in_processes(options: argparse.Namespace, console: Console) -> dict[str, Row] | None:
    """Every section's row, and the machine's facts; None where there is no GPU."""
    rows: dict[str, Row] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows"
        while remaining := [name for name in options.only if name not in rows]:
            path.write_text("")
            flags = [flag for flag in ("emulate", "quick") if getattr(options, flag)]
            command = [sys.executable, __file__, *(f"--{flag}" for flag in flags)]
            process = subprocess.Popen([*command, "--rows", str(path), "--only", *remaining])
            ended = _watch(process, path, remaining, console)
            if process.returncode == _NO_GPU:
                return None
            rows |= _rows_in(path)
            unfinished = [name for name in remaining if name not in rows]
            if unfinished and ended is not None:
                rows[unfinished[0]] = {"result": "FAILED", "told": ended, "seconds": 0.0}
    return rows


def _watch(
    process: "subprocess.Popen[bytes]", path: Path, names: Sequence[str], console: Console
) -> str | None:
    """Wait for the process; returns why its last section has no row, None where it chose to end."""
    done, since = 0, time.monotonic()
    with console.status(names[0]) as status:
        while process.poll() is None:
            time.sleep(0.1)
            count = sum(name in _rows_in(path) for name in names)
            if count > done:
                done, since = count, time.monotonic()
                status.update(names[min(done, len(names) - 1)])
            elif time.monotonic() - since > LIMIT_S:
                process.kill()
                process.wait()
                return f"took longer than {LIMIT_S} s"
    return None if process.returncode == 0 else f"the process ended with {process.returncode}"


def _rows_in(path: Path) -> dict[str, Row]:
    """What was written, but for a line that is being written."""
    whole = path.read_text().rpartition("\n")[0]
    return {name: row for name, row in map(json.loads, whole.splitlines())}


def _ask_all(options: argparse.Namespace) -> int:
    """Ask the sections in this process; ends early where a kernel has spoilt it."""
    import torch

    if not options.emulate and not torch.cuda.is_available():
        told = "torch sees no NVIDIA GPU, which is what is to be checked; --emulate needs none."
        print(told, file=sys.stderr)
        return _NO_GPU
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    try:
        importlib.import_module("roma")
    except ModuleNotFoundError:
        # The head's module of rotations imports it, for conversions that nothing here asks for.
        sys.modules["roma"] = types.ModuleType("roma")
    with _place(options) as place, options.rows.open("a") as file:

        def write(name: str, row: Row) -> None:
            file.write(json.dumps([name, row], default=_plain) + "\n")
            file.flush()

        write(_MACHINE, _facts(options))
        for name in options.only:
            row = _ask(name, place)
            write(name, row)
            if row["result"] == "FAILED":
                try:
                    place.wait()
                except RuntimeError:
                    return 0
    return 0


@contextmanager
def _place(options: argparse.Namespace) -> Iterator[Any]:
    import pytest
    import torch
    from gpu_sections import Place

    if not options.emulate:
        yield Place(torch.device("cuda", torch.cuda.current_device()), False, options.quick)
        return
    from tests.kernels.cuda import emulator

    with pytest.MonkeyPatch.context() as patch:
        emulator.install(patch)
        yield Place(torch.device("cpu"), True, options.quick)


def _ask(name: str, place: Any) -> Row:
    """One section's row; whatever it raises is its result."""
    start = time.perf_counter()
    module, function = SECTIONS[name]
    try:
        found = getattr(importlib.import_module(module), function)(place)
        result = {True: "ok", False: "FAILED", None: "left out"}[found.passed]
        row = {"result": result, "told": found.told, "figures": found.figures}
    except Exception as error:
        cause = f"{type(error).__name__}: {error}".splitlines()[0]
        row = {"result": "FAILED", "told": cause, "traceback": traceback.format_exc()}
    return row | {"seconds": time.perf_counter() - start}


def _facts(options: argparse.Namespace) -> dict[str, Any]:
    import torch

    from rgbavatar_ns.bench.machine import machine_facts

    memory = driver = None
    if not options.emulate:
        properties: Any = torch.cuda.get_device_properties(torch.cuda.current_device())
        memory, driver = properties.total_memory, _driver_version()
    return machine_facts() | {
        "cuda": torch.version.cuda,
        "driver": driver,
        "gpu_memory_bytes": memory,
        "emulated": options.emulate,
        "quick": options.quick,
    }


def _driver_version() -> str:
    try:
        pynvml: Any = importlib.import_module("pynvml")
        pynvml.nvmlInit()
        return pynvml.nvmlSystemGetDriverVersion()
    # NVML's own classes of errors cannot be named where it is missing.
    except Exception as error:
        return f"not told ({type(error).__name__})"


def _print(rows: dict[str, Row], facts: Row, console: Console) -> None:
    table = Table("section", "result", "found", "s")
    table.columns[-1].justify = "right"
    for name, row in rows.items():
        if "traceback" in row:
            console.print(row["traceback"], markup=False, highlight=False)
        table.add_row(name, row["result"], escape(row["told"]), f"{row['seconds']:.1f}")
    console.print(table)
    told = ", ".join(f"{name} {value}" for name, value in facts.items() if value is not None)
    console.print(told, markup=False, highlight=False)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    raise TypeError(type(value).__name__)


if __name__ == "__main__":
    sys.exit(main())
