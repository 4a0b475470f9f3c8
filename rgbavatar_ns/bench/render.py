"""`rgbavatar bench render`: from theta to the image, one image at a time."""

from collections.abc import Callable
from itertools import cycle
from typing import Any

import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.composition import to_world
from rgbavatar_ns.avatar.training import TrainingBatch
from rgbavatar_ns.bench.floor import floor_figures, measure_speed, parameter_work, rasterizer_work
from rgbavatar_ns.bench.machine import machine_facts, require_backend
from rgbavatar_ns.bench.options import RenderOptions
from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.projection import one_camera
from rgbavatar_ns.bench.report import Report
from rgbavatar_ns.bench.timing import (
    PEAK_MEMORY_METHOD,
    Progress,
    Spread,
    Stopwatch,
    peak_growth_bytes,
    using_threads,
)
from rgbavatar_ns.bench.workloads import AvatarWorkload, avatar_workload
from rgbavatar_ns.kernels import PinholeCameras, rasterize

WHOLE_FRAME = "whole frame"


@torch.no_grad()
def bench_render(options: RenderOptions, progress: Progress | None = None) -> Report:
    """Measure what the options say; raises UserError where that cannot be done here."""
    backend = require_backend()
    with using_threads(options.threads) as threads:
        workload = avatar_workload(options, options.frames, with_images=False)
        facts = workload.facts | {"frames": options.frames, "batch": 1}
        facts |= {"backend": backend, "threads": threads}
        stopwatch = Stopwatch(options.repetitions, progress)
        frame = _frames_in_turn(workload.avatar, workload.batch)
        growth_bytes = peak_growth_bytes(frame)
        whole = stopwatch.time(WHOLE_FRAME, frame)
        spread = {WHOLE_FRAME: whole} | _time_parts(workload, stopwatch)
        return _report(workload, facts, spread, growth_bytes)


def _frames_in_turn(avatar: Avatar, batch: TrainingBatch) -> Callable[[], Any]:
    frames = cycle(
        [
            (batch.theta[position : position + 1], one_camera(batch.cameras, position))
            for position in range(len(batch.theta))
        ]
    )
    return lambda: avatar.render(*next(frames))


def _time_parts(workload: AvatarWorkload, stopwatch: Stopwatch) -> dict[str, Spread]:
    """Times of one frame's parts by the readable path, one after another."""
    avatar, theta = workload.avatar, workload.batch.theta[:1]
    camera: PinholeCameras = one_camera(workload.batch.cameras, 0)
    ratio = avatar.config.scale_with_triangle
    vertices = avatar.head(theta, avatar.identity)
    psi = avatar.weights(theta)
    tangent = avatar.blendshapes.blend(psi)
    frames = avatar.anchors.frames(vertices, with_length_ratio=ratio)
    gaussians = to_world(tangent, frames)
    parts: dict[str, Callable[[], Any]] = {
        "head": lambda: avatar.head(theta, avatar.identity),
        "network": lambda: avatar.weights(theta),
        "blend": lambda: avatar.blendshapes.blend(psi),
        "frames": lambda: avatar.anchors.frames(vertices, with_length_ratio=ratio),
        "transform": lambda: to_world(tangent, frames),
        "rasterize": lambda: rasterize(gaussians, camera),
    }
    return {name: stopwatch.time(name, part) for name, part in parts.items()}


def _report(
    workload: AvatarWorkload,
    facts: dict[str, Any],
    spread: dict[str, Spread],
    growth_bytes: int | None,
) -> Report:
    theta, cameras = workload.batch.theta, workload.batch.cameras
    gaussians = workload.avatar.gaussians(theta)
    pairs = count_pairs(gaussians, cameras) / len(theta)
    whole_ms = spread[WHOLE_FRAME].median_ms
    one = workload.avatar.gaussians(theta[:1])
    works = [
        rasterizer_work(round(pairs), one, one_camera(cameras, 0), backward=False),
        parameter_work([p for g in workload.avatar.parameter_groups().values() for p in g]),
    ]
    return Report(
        benchmark="render",
        workload=facts,
        forward_ms_per_image=whole_ms,
        backward_ms_per_image=None,
        images_per_second=1e3 / whole_ms,
        frames_per_second=1e3 / whole_ms,
        parts={name: part.median_ms for name, part in spread.items()},
        spread=spread,
        pairs={"per_image": pairs, "per_second": 1e3 * pairs / whole_ms},
        memory={"bytes_per_image": growth_bytes, "method": PEAK_MEMORY_METHOD},
        floor=floor_figures(works, measure_speed(), 1, whole_ms),
        peers={},
        machine=machine_facts(),
    )
