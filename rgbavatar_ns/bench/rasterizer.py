"""`rgbavatar bench rasterizer`: forward and backward of a batch of Gaussian sets."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.bench import timing
from rgbavatar_ns.bench.gsplat_torch import gsplat_torch
from rgbavatar_ns.bench.machine import chosen_device, require_backend
from rgbavatar_ns.bench.options import AvatarOptions, RasterizerOptions
from rgbavatar_ns.bench.pairs import count_pairs, one_image
from rgbavatar_ns.bench.report import Report
from rgbavatar_ns.bench.roofline import measure_speed, rasterizer_work, roofline_figures
from rgbavatar_ns.bench.scenes import (
    DEFAULT_COUNT,
    DEFAULT_SIZE_PX,
    ellipsoid_scene,
    leaf_gaussians,
    on_device,
)
from rgbavatar_ns.bench.timing import (
    Lap,
    Progress,
    Spread,
    Stopwatch,
    peak_growth_bytes,
)
from rgbavatar_ns.bench.workloads import avatar_workload
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize
from rgbavatar_ns.threads import using_threads

FORWARD, BACKWARD = "forward, no gradients", "backward"
WHOLE = "forward and backward"
GSPLAT = "gsplat torch"
_NOT_ON_GPUS = "drawn on a CPU only; benchmarks/gpu_check.py has gsplat's kernels"

Draw = Callable[[GaussianSet], Float[Tensor, "B H W 3"]]


def bench_rasterizer(options: RasterizerOptions, progress: Progress | None = None) -> Report:
    """Measure what the options say; raises UserError where that cannot be done here."""
    device = chosen_device(options.device, options.backend)
    backend = require_backend(options.backend, device)
    with using_threads(options.threads) as threads:
        gaussians, cameras, facts = _workload(options)
        gaussians, cameras = on_device(gaussians, device), on_device(cameras, device)
        facts |= {"batch": options.batch, "backend": backend, "threads": threads}
        facts |= {"device": device.type}
        stopwatch = Stopwatch(options.repetitions, progress)
        spread, growth_bytes = time_rasterizer(gaussians, cameras, stopwatch, options.backend)
        whole_ms = spread[WHOLE].median_ms / options.batch
        peers = {}
        if options.peers and device.type == "cuda":
            peers = {GSPLAT: {"unavailable": _NOT_ON_GPUS}}
        elif options.peers:
            few = replace(stopwatch, repetitions=options.peer_repetitions, warm_up=False)
            peers = {GSPLAT: time_gsplat(gaussians, cameras, few, whole_ms)}
        return Report(
            benchmark="rasterizer",
            workload=facts,
            images_per_second=1e3 / whole_ms,
            spread=spread,
            bytes_per_image=None if growth_bytes is None else growth_bytes // options.batch,
            roofline=_roofline(gaussians, cameras, spread, options.batch),
            peers=peers,
            forward_ms_per_image=spread[FORWARD].median_ms / options.batch,
            backward_ms_per_image=spread[BACKWARD].median_ms / options.batch,
        )


def time_rasterizer(
    gaussians: GaussianSet, cameras: PinholeCameras, stopwatch: Stopwatch, backend: str = "auto"
) -> tuple[dict[str, Spread], int | None]:
    """Time a batch with one of our backends, and the memory it needs, as `time_draw`."""

    def draw(gaussians: GaussianSet) -> Tensor:
        return rasterize(gaussians, cameras, backend=backend).image

    return time_draw(WHOLE, draw, gaussians, cameras, stopwatch)


def time_draw(
    what: str, draw: Draw, gaussians: GaussianSet, cameras: PinholeCameras, stopwatch: Stopwatch
) -> tuple[dict[str, Spread], int | None]:
    """Time forward and backward to all attributes, from a random gradient of the image.

    Also returns the memory of the first forward and backward (see `peak_growth_bytes`).
    """
    device, leaves = gaussians.means.device, leaf_gaussians(gaussians)
    batch = max(len(gaussians.means), len(cameras.focal_px))
    generator = torch.Generator().manual_seed(1)
    image_grad = torch.randn(batch, cameras.height, cameras.width, 3, generator=generator)
    image_grad = (image_grad / cameras.height**2).to(device)

    def once(lap: Lap) -> None:
        for leaf in vars(leaves).values():
            leaf.grad = None
        image = draw(leaves)
        lap("forward, for the backward")
        image.backward(image_grad)
        lap(BACKWARD)

    growth_bytes = peak_growth_bytes(lambda: once(lambda name: None), device)
    spread = stopwatch.laps(what, once)
    spread[WHOLE] = spread.pop(timing.WHOLE)
    forward = stopwatch.time(FORWARD, lambda: torch.no_grad()(draw)(gaussians))
    return {FORWARD: forward, **spread}, growth_bytes


def time_gsplat(
    gaussians: GaussianSet, cameras: PinholeCameras, stopwatch: Stopwatch, ours_ms: float
) -> dict[str, Any]:
    """gsplat's torch functions on the batch's first image, or {"unavailable": reason}.

    `ratio` is their forward and backward over ours an image in the whole batch.
    """
    single, camera = one_image(gaussians, cameras, 0)
    try:
        draw = gsplat_torch(single, camera)
        with torch.no_grad():
            difference = (draw(single) - rasterize(single, camera).image).abs()
        spread, growth_bytes = time_draw(GSPLAT, draw, single, camera, stopwatch)
    except (ImportError, RuntimeError, AttributeError, OSError) as error:
        reason = (str(error).splitlines() or [""])[0]
        return {"unavailable": f"{type(error).__name__}: {reason}"}
    return {
        "forward_ms_per_image": spread[FORWARD].median_ms,
        "backward_ms_per_image": spread[BACKWARD].median_ms,
        "whole_ms_per_image": spread[WHOLE].median_ms,
        "ratio": spread[WHOLE].median_ms / ours_ms,
        "bytes_per_image": growth_bytes,
        "mean_difference": float(difference.mean()),
    }


def _roofline(
    gaussians: GaussianSet, cameras: PinholeCameras, spread: dict[str, Spread], images: int
) -> dict[str, Any]:
    """Of forward and backward together, and under "forward" of the forward pass alone."""
    pairs, speed = count_pairs(gaussians, cameras), measure_speed(gaussians.means.device)

    def figures(reached: Spread, *, backward: bool) -> dict[str, Any]:
        work = rasterizer_work(pairs, gaussians, cameras, backward=backward)
        return roofline_figures([work], speed, images, reached.median_ms / images, pairs / images)

    forward = figures(spread[FORWARD], backward=False)
    return figures(spread[WHOLE], backward=True) | {"forward": forward}


def _workload(options: RasterizerOptions) -> tuple[GaussianSet, PinholeCameras, dict[str, Any]]:
    if options.avatar is None:
        count = options.count or DEFAULT_COUNT
        size_px = options.size or DEFAULT_SIZE_PX
        scene = ellipsoid_scene(count, size_px, options.batch, shared=options.shared)
        shared = "opacities and scales" if options.shared else "nothing"
        facts = {"name": "ellipsoid", "gaussians": count, "shared": shared}
        return *scene, facts | {"width_px": size_px, "height_px": size_px}
    drawn = AvatarOptions(avatar=options.avatar, data=options.data, size=options.size)
    workload = avatar_workload(drawn, options.batch, with_images=False)
    with torch.no_grad():
        gaussians = workload.avatar.gaussians(workload.batch.theta)
    return gaussians, workload.batch.cameras, {"name": "avatar", **workload.facts}
