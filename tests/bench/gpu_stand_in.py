"""Sections of the GPU's check on an emulated GPU, in a process that lacks what a bare machine does.

    python -m tests.bench.gpu_stand_in SECTION ...

Prints the rows of each as the check's child would send them, after a line with its name.
"""

import json
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import setuptools

from benchmarks.gpu.rows import Rows, SectionEnded

ENOUGH = (
    *("torch", "numpy", "scipy", "jaxtyping", "safetensors"),
    *("cuda-bindings", "nvidia-cuda-nvrtc"),
)
"""What a machine with a GPU must have, and what these bring."""


def absent() -> set[str]:
    """The modules of every other installed package, and our compiled ones."""
    brought: set[str] = set()
    waiting = list(ENOUGH)
    while waiting:
        name = _plain(waiting.pop())
        if name in brought:
            continue
        brought.add(name)
        with suppress(metadata.PackageNotFoundError):
            needs = metadata.requires(name) or []
            waiting += [re.split(r"[^\w.-]", need)[0] for need in needs if "extra ==" not in need]
    owners = metadata.packages_distributions().items()
    others = {module for module, of in owners if not brought & {_plain(name) for name in of}}
    # setuptools, which torch's own timer imports, has copies of what it needs.
    copies = {path.name for path in Path(setuptools.__file__).parent.glob("_vendor/*")}
    ours = {"rgbavatar_ns", "benchmarks", "tests"}
    return (others - copies - ours) | {"rgbavatar_ns.kernels.cpu._native"}


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def rows_from(section: Callable[[Rows], object]) -> dict[str, Any]:
    """The rows that a section sends."""
    lines: list[str] = []
    with suppress(SectionEnded):
        section(Rows(lines.append))
    messages = [message for message in map(json.loads, lines) if "row" in message]
    return {message["row"]: message["figures"] for message in messages}


def main(names: list[str]) -> None:
    missing = absent()
    assert {"nerfstudio", "cv2", "roma", "rich", "pytest"} <= missing
    assert not {"torch", "numpy", "filelock"} & missing
    sys.modules.update(dict.fromkeys(missing))  # type: ignore[arg-type]

    import torch

    from benchmarks.gpu import small_case, times
    from benchmarks.gpu.child import run_section
    from benchmarks.gpu.sections import chosen_sections
    from benchmarks.gpu.workload import Workload
    from rgbavatar_ns.bench.roofline import measure_speed
    from rgbavatar_ns.kernels import registry
    from tests.kernels.cuda import emulator

    backend, real = emulator.load(), registry._load
    registry._load = lambda name: backend if name == "cuda" else real(name)  # type: ignore
    speed = measure_speed(matrix_side=64, copy_mib=1, seconds=0.001)
    times.measure_speed = lambda device: speed

    class Emulated(Workload):
        on_gpu = True

    class Event:
        def __init__(self, enable_timing: bool) -> None: ...
        def record(self) -> None: ...
        def synchronize(self) -> None: ...
        def elapsed_time(self, end: object) -> float:
            return 1.0

    torch.cuda.Event = Event  # type: ignore[assignment,misc]
    for name in ("synchronize", "_sleep", "empty_cache", "reset_peak_memory_stats"):
        setattr(torch.cuda, name, lambda *_: None)
    for name in ("start", "stop"):
        setattr(torch.cuda.profiler, name, lambda: None)
    torch.cuda.mem_get_info = lambda device: (1 << 30, 4 << 30)
    torch.cuda.max_memory_allocated = torch.cuda.max_memory_reserved = lambda device: 5 << 20
    tiny = Emulated(
        *(torch.device("cpu"), 0.001, 0.001, 2, lambda work: work, 60, 16),
        batch=1,
        frames=2,
        uv_resolution=12,
        crowd=200,
    )
    Workload.here = classmethod(lambda cls: tiny)  # type: ignore[assignment]
    for name in names:
        if name in small_case.CASES:
            small_case.main(name, tiny)
            continue
        print(name)
        (section,) = chosen_sections(name)
        run_section(section, Rows(lambda line: print(line, end="")))


if __name__ == "__main__":
    main(sys.argv[1:])
