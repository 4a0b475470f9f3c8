"""Times of whole steps, of rendering and of the rasterizer, as a user would see them."""

import time
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.gpu.rows import Figures, Rows
from benchmarks.gpu.targets import FRAMES_PER_SECOND, IMAGES_PER_SECOND, at_least
from benchmarks.gpu.workload import Training, Workload
from rgbavatar_ns.avatar.recorded_rendering import RecordedRendering
from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.roofline import measure_speed, rasterizer_work, roofline_figures
from rgbavatar_ns.bench.scenes import leaf_gaussians
from rgbavatar_ns.bench.timing import peak_growth_bytes
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize

Draw = Callable[[GaussianSet], Tensor]


def steps(rows: Rows) -> None:
    """Images a second of a whole step, as one CUDA graph and kernel by kernel."""
    work = Workload.here()
    with rows.row("recorded") as figures:
        figures |= _step_figures(work, "recorded")
        figures |= at_least(figures["images_per_second"], IMAGES_PER_SECOND)
    with rows.row("fused") as figures:
        figures |= _step_figures(work, "fused")


def _step_figures(work: Workload, kind: str) -> Figures:
    if work.on_gpu:
        torch.cuda.reset_peak_memory_stats(work.device)
    training = Training(work)
    take = getattr(training, kind)()
    found = work.time(take)
    work.wait()
    start = time.perf_counter()
    for _ in range(work.calls):
        take()
    host_s = (time.perf_counter() - start) / work.calls
    return {
        "gaussians": training.avatar.num_gaussians,
        "images_per_second": work.batch / found.median,
        "median_ms": 1e3 * found.median,
        "iqr_ms": 1e3 * found.iqr,
        "host_ms": 1e3 * host_s,
        **_memory(work),
    }


def _memory(work: Workload) -> Figures:
    """Most memory in use since the start; nothing on what stands for a GPU."""
    if not work.on_gpu:
        return {}
    free, total = torch.cuda.mem_get_info(work.device)
    return {
        "peak_mib": torch.cuda.max_memory_allocated(work.device) >> 20,
        "peak_reserved_mib": torch.cuda.max_memory_reserved(work.device) >> 20,
        "in_use_on_the_gpu_mib": (total - free) >> 20,
    }


@torch.no_grad()
def rendering(rows: Rows) -> None:
    """Frames a second from theta to image, one at a time and by the batch."""
    work = Workload.here()
    training = Training(work)
    avatar, cameras = training.avatar, training.frames.cameras
    for size in sorted({1, work.batch}):
        theta = training.frames.theta[:size]
        recorded = RecordedRendering(avatar, theta, cameras, backend="cuda", recorder=work.recorder)
        ways = {
            "recorded": lambda theta=theta, draw=recorded: draw(theta),
            "fused": lambda theta=theta: avatar.render(theta, cameras, backend="cuda"),
        }
        for name, draw in ways.items():
            with rows.row(f"{name}_by_{size}") as figures:
                figures["frames_per_second"] = size / work.time(draw).median
                if name == "recorded":
                    figures |= at_least(figures["frames_per_second"], FRAMES_PER_SECOND)


def rasterizer(rows: Rows) -> None:
    """Forward without gradients, forward and backward to all attributes; memory, roofline."""
    work = Workload.here()
    gaussians, cameras = work.scene()
    with rows.row("times") as figures:
        figures |= time_draw(work, gaussians, ours(cameras))
        each_ms = figures["both"]["median_ms"] / work.batch
    with rows.row("roofline") as figures:
        pairs, speed = count_pairs(gaussians, cameras), measure_speed(work.device)
        both = rasterizer_work(pairs, gaussians, cameras, backward=True)
        figures |= roofline_figures([both], speed, work.batch, each_ms, pairs / work.batch)


def ours(cameras: PinholeCameras) -> Draw:
    """Our kernels."""
    return lambda gaussians: rasterize(gaussians, cameras, backend="cuda").image


def time_draw(work: Workload, gaussians: GaussianSet, draw: Draw) -> Figures:
    """Times of a batch, and the memory of forward and backward."""
    leaves = leaf_gaussians(gaussians)
    with torch.no_grad():
        image_grad = torch.randn_like(draw(leaves)) / work.size_px**2

    def both() -> None:
        for leaf in vars(leaves).values():
            leaf.grad = None
        draw(leaves).backward(image_grad)

    return {
        "forward": work.figures(lambda: torch.no_grad()(draw)(gaussians)),
        "both": work.figures(both),
        "bytes": peak_growth_bytes(both, work.device),
    }
