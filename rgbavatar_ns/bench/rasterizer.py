"""`rgbavatar bench rasterizer`: forward and backward of a batch of Gaussian sets."""

from dataclasses import dataclass
from typing import Any

import torch

from rgbavatar_ns.bench.drawing import Draw, DrawTimes, time_draw
from rgbavatar_ns.bench.machine import chosen_device, machine_facts, require_backend
from rgbavatar_ns.bench.options import AvatarOptions, RasterizerOptions
from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.peers import PEERS, time_peers
from rgbavatar_ns.bench.report import Report
from rgbavatar_ns.bench.roofline import measure_speed, rasterizer_work, roofline_figures
from rgbavatar_ns.bench.scenes import DEFAULT_COUNT, DEFAULT_SIZE_PX, ellipsoid_scene, on_device
from rgbavatar_ns.bench.timing import (
    Progress,
    Spread,
    Stopwatch,
    peak_memory_method,
    using_threads,
    waiting_for,
)
from rgbavatar_ns.bench.workloads import avatar_workload
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize

_NO_PEERS_ON_GPUS = "drawn on a CPU only; benchmarks/gpu_check.py has gsplat's kernels"


@dataclass(frozen=True)
class RasterizerTimes:
    """A batch's times: forward without gradients, and forward with backward."""

    forward: Spread
    training: DrawTimes


def bench_rasterizer(options: RasterizerOptions, progress: Progress | None = None) -> Report:
    """Measure what the options say; raises UserError where that cannot be done here."""
    device = chosen_device(options.device, options.backend)
    backend = require_backend(options.backend, device)
    with using_threads(options.threads) as threads:
        gaussians, cameras, facts = _workload(options)
        gaussians, cameras = on_device(gaussians, device), on_device(cameras, device)
        facts |= {"batch": options.batch, "backend": backend, "threads": threads}
        facts |= {"device": device.type}
        pairs = count_pairs(gaussians, cameras)
        stopwatch = Stopwatch(options.repetitions, progress, wait=waiting_for(device))
        times = time_rasterizer(gaussians, cameras, stopwatch, options.backend)
        whole_ms = times.training.whole.median_ms / options.batch
        peers: dict[str, Any] = {}
        if options.peers and device.type == "cuda":
            peers = {name: {"unavailable": _NO_PEERS_ON_GPUS} for name in PEERS}
        elif options.peers:
            few = Stopwatch(options.peer_repetitions, progress, warm_up=False)

            def ours(gaussians: GaussianSet, cameras: PinholeCameras) -> Draw:
                return lambda leaves: rasterize(leaves, cameras, backend=options.backend).image

            peers = time_peers(ours, gaussians, cameras, whole_ms, few)
        return _report(options.batch, times, facts, gaussians, cameras, pairs, peers)


def time_rasterizer(
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    stopwatch: Stopwatch,
    backend: str = "auto",
) -> RasterizerTimes:
    """Time a batch with one of our backends."""
    batch = max(len(gaussians.means), len(cameras.focal_px))

    @torch.no_grad()
    def forward() -> None:
        rasterize(gaussians, cameras, backend=backend)

    training = time_draw(
        "forward and backward",
        lambda leaves: rasterize(leaves, cameras, backend=backend).image,
        gaussians,
        (batch, cameras.height, cameras.width, 3),
        stopwatch,
    )
    return RasterizerTimes(stopwatch.time("forward", forward), training)


def _workload(
    options: RasterizerOptions,
) -> tuple[GaussianSet, PinholeCameras, dict[str, Any]]:
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


def _report(
    batch: int,
    times: RasterizerTimes,
    facts: dict[str, Any],
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    pairs: int,
    peers: dict[str, Any],
) -> Report:
    whole_ms = times.training.whole.median_ms
    spread = {
        "forward, no gradients": times.forward,
        "forward, for the backward": times.training.forward,
        "backward": times.training.backward,
        "forward and backward": times.training.whole,
    }
    speed = measure_speed(gaussians.means.device)
    both = rasterizer_work(pairs, gaussians, cameras, backward=True)
    forward = rasterizer_work(pairs, gaussians, cameras, backward=False)
    floor = roofline_figures([both], speed, batch, whole_ms / batch)
    floor["forward"] = roofline_figures([forward], speed, batch, times.forward.median_ms / batch)
    growth = times.training.growth_bytes
    return Report(
        benchmark="rasterizer",
        workload=facts,
        forward_ms_per_image=times.forward.median_ms / batch,
        backward_ms_per_image=times.training.backward.median_ms / batch,
        images_per_second=1e3 * batch / whole_ms,
        frames_per_second=None,
        parts={name: part.median_ms for name, part in spread.items()},
        spread=spread,
        pairs={
            "per_image": pairs / batch,
            "per_second": 1e3 * pairs / whole_ms,
            "per_second_forward": 1e3 * pairs / times.forward.median_ms,
        },
        memory={
            "bytes_per_image": None if growth is None else growth // batch,
            "method": peak_memory_method(gaussians.means.device),
        },
        floor=floor,
        peers=peers,
        machine=machine_facts(),
    )
