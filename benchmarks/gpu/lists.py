"""How long tiles' lists are, and how much of the room for them is used."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from benchmarks.gpu.rows import Figures, Rows, check
from benchmarks.gpu.workload import Training, Workload
from rgbavatar_ns.kernels import rasterize
from rgbavatar_ns.kernels.cuda.launcher import Launcher
from rgbavatar_ns.kernels.cuda.source import constants

_QUANTILES = {"median": 0.5, "percentile_99": 0.99, "most": 1.0}


def lists(rows: Rows) -> None:
    """Of a training step, and of the rasterizer's common workload."""
    work = Workload.here()
    step = Training(work).fused()
    step()
    gaussians, cameras = work.scene()
    cases: dict[str, Callable[[], Any]] = {
        "step": step,
        "rasterizer": lambda: rasterize(gaussians, cameras, backend="cuda"),
    }
    for name, call in cases.items():
        with rows.row(name) as figures:
            with watched_bins(work.launcher()) as seen:
                call()
                work.wait()
            figures |= list_figures(seen[-1])


@contextmanager
def watched_bins(launcher: Launcher) -> Iterator[list[Mapping[str, Any]]]:
    """The `Bins` (arguments.h) of all launches within that have them."""
    whole: Any = launcher
    launch, seen = whole.launch, []

    def watched(kernel: str, *arguments: Any, **values: Any) -> None:
        launch(kernel, *arguments, **values)
        if "bins" in values:
            seen.append(values["bins"])

    whole.launch = watched
    try:
        yield seen
    finally:
        del whole.launch


def list_figures(bins: Mapping[str, Any]) -> Figures:
    """Lengths over all tiles and over those that anything touches; room that was needed."""
    starts: Tensor = bins["tile_start"].long().cpu()
    lengths = starts.diff().double()
    filled = lengths[lengths > 0]
    status, capacity = bins["status"].tolist(), bins["capacity"]
    overflow = constants()["kOverflow"]
    needed = max(status[:overflow])
    figures: Figures = {
        "tiles": len(lengths),
        "empty_share": float((lengths == 0).double().mean()),
        "entries": int(starts[-1]),
        "capacity": capacity,
        "used_share": needed / capacity,
    }
    for name, quantile in _QUANTILES.items():
        figures[name] = float(torch.quantile(filled, quantile)) if len(filled) else 0.0
    check(figures, not status[overflow], "the lists overflowed")
    return figures
