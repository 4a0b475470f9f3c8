"""gsplat's kernels on the same Gaussians, its times over ours, measured before and after."""

import importlib
import statistics
from typing import Any

import torch
from torch import Tensor

from benchmarks.gpu.rows import Figures, LeftOut, Rows
from benchmarks.gpu.times import Draw, ours, time_draw
from benchmarks.gpu.workload import Workload
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras

_TIMES = ("forward", "both")


def gsplat(rows: Rows) -> None:
    """All images in one call, where its version can, and one after another."""
    work = Workload.here()
    with rows.row("library") as figures:
        library = _library()
        figures["version"] = library.__version__
    with rows.row("ours_before") as figures:
        gaussians, cameras = work.scene()
        before = time_draw(work, gaussians, ours(cameras))
        figures |= before
    found: dict[str, Figures] = {}
    for name, draw in _ways(library, cameras, work.batch).items():
        with rows.row(name) as figures:
            try:
                with torch.no_grad():
                    difference = (draw(gaussians) - ours(cameras)(gaussians)).abs().mean()
                found[name] = time_draw(work, gaussians, draw)
                figures |= found[name] | {"mean_difference": float(difference)}
            # Versions before 1.5 have no batches of Gaussians, and refuse them in many ways.
            except Exception as error:
                figures["unavailable"] = f"{type(error).__name__}: {error}"[:300]
    with rows.row("ours_after") as figures:
        after = time_draw(work, gaussians, ours(cameras))
        figures |= after
    with rows.row("over_ours") as figures:
        own = {k: statistics.mean(each[k]["median_ms"] for each in (before, after)) for k in _TIMES}
        for name, times in found.items():
            figures[name] = {k: times[k]["median_ms"] / own[k] for k in _TIMES}


def _library() -> Any:
    try:
        return importlib.import_module("gsplat")
    # It compiles, or loads what was compiled for another torch, when it is imported.
    except Exception as error:
        raise LeftOut(
            f"gsplat cannot be imported: {type(error).__name__}: {error}"[:500],
            "To compare with it: pip install gsplat, a wheel of torch's and CUDA's versions.",
        ) from error


def _ways(library: Any, cameras: PinholeCameras, batch: int) -> dict[str, Draw]:
    matrix = torch.zeros(3, 3, device=cameras.focal_px.device)
    matrix[0, 0], matrix[1, 1] = cameras.focal_px[0]
    matrix[0, 2], matrix[1, 2] = cameras.principal_point_px[0]
    matrix[2, 2] = 1

    def call(leaves: GaussianSet, lead: tuple[int, ...], part: Any) -> Tensor:
        return library.rasterization(
            *(getattr(leaves, name)[part] for name in vars(leaves)),
            viewmats=cameras.world_to_camera[0].expand(*lead, 1, 4, 4),
            Ks=matrix.expand(*lead, 1, 3, 3),
            width=cameras.width,
            height=cameras.height,
            packed=False,
        )[0]

    def batched(leaves: GaussianSet) -> Tensor:
        return call(leaves, (batch,), slice(None))[:, 0]

    def one_by_one(leaves: GaussianSet) -> Tensor:
        return torch.cat([call(leaves, (), position) for position in range(batch)])

    return {"batched": batched, "one_by_one": one_by_one}
