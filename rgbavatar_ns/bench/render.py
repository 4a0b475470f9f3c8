"""`rgbavatar bench render`: from theta to the image, one image at a time."""

from collections.abc import Callable
from functools import partial
from itertools import cycle
from typing import Any

import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.recorded_rendering import RecordedRendering
from rgbavatar_ns.avatar.training import TrainingBatch
from rgbavatar_ns.avatar.training.cuda_graph import supports
from rgbavatar_ns.bench.machine import chosen_device, require_backend
from rgbavatar_ns.bench.options import RenderOptions
from rgbavatar_ns.bench.pairs import count_pairs, one_camera
from rgbavatar_ns.bench.report import Report
from rgbavatar_ns.bench.roofline import (
    measure_speed,
    parameter_work,
    rasterizer_work,
    roofline_figures,
)
from rgbavatar_ns.bench.timing import (
    WHOLE,
    Lap,
    Progress,
    Spread,
    Stopwatch,
    peak_growth_bytes,
)
from rgbavatar_ns.bench.workloads import AvatarWorkload, avatar_workload, parameters_of
from rgbavatar_ns.drawing.compositing import to_uint8
from rgbavatar_ns.kernels import rasterize
from rgbavatar_ns.threads import using_threads

WHOLE_FRAME = "whole frame"
VIEWER_FRAME = "(the viewer's picture, as bytes)"
EAGER_FRAME = "whole frame, eager"


@torch.no_grad()
def bench_render(options: RenderOptions, progress: Progress | None = None) -> Report:
    """Measure what the options say; raises UserError where that cannot be done here."""
    device = chosen_device(options.device)
    backend = require_backend("auto", device)
    with using_threads(options.threads) as threads:
        workload = avatar_workload(options, options.frames, with_images=False, device=device)
        facts = workload.facts | {"frames": options.frames, "batch": 1}
        facts |= {"backend": backend, "threads": threads}
        stopwatch = Stopwatch(options.repetitions, progress)
        frame = _frames_in_turn(workload.avatar, workload.batch)
        growth_bytes = peak_growth_bytes(frame, device)
        whole = stopwatch.time(WHOLE_FRAME, frame)
        spread = {WHOLE_FRAME: whole} | _time_parts(workload, stopwatch)
        spread[VIEWER_FRAME] = stopwatch.time(VIEWER_FRAME, _viewer_frames_in_turn(workload))
        avatar, theta = workload.avatar, workload.batch.theta[:1]
        camera = one_camera(workload.batch.cameras, 0)
        spread[EAGER_FRAME] = stopwatch.time(
            EAGER_FRAME, lambda: rasterize(avatar.gaussians(theta), camera)
        )
        return _report(workload, facts, spread, growth_bytes)


def _frames_in_turn(avatar: Avatar, batch: TrainingBatch) -> Callable[[], Any]:
    thetas = batch.theta.split(1)
    frames = cycle([(one, one_camera(batch.cameras, k)) for k, one in enumerate(thetas)])
    theta, camera = next(frames)
    # Where a device can take whole pictures by itself, that is how they are drawn in a row.
    recorded = supports(avatar, theta, camera)
    if recorded:
        draw = RecordedRendering(avatar, theta, camera)
    else:
        draw = partial(avatar.render, to_be_seen=True)
    return lambda: draw(*next(frames))


def _viewer_frames_in_turn(workload: AvatarWorkload) -> Callable[[], Any]:
    """What nerfstudio's viewer shows of each frame, before it is compressed and sent."""
    from rgbavatar_ns.plugin.viewer.driving import DrivingSignal
    from rgbavatar_ns.plugin.viewer.render import viewer_render
    from rgbavatar_ns.plugin.viewer.viewer_state import ViewerState

    thetas, state = workload.batch.theta.split(1), ViewerState()
    frames = cycle([(DrivingSignal(one), k) for k, one in enumerate(thetas)])

    def frame() -> Any:
        signal, number = next(frames)
        camera = one_camera(workload.batch.cameras, number)
        return to_uint8(viewer_render(workload.avatar, signal, state, camera).image)

    return frame


def _time_parts(workload: AvatarWorkload, stopwatch: Stopwatch) -> dict[str, Spread]:
    """Times of one frame's parts as they follow one another."""
    avatar, theta = workload.avatar, workload.batch.theta[:1]
    camera, background = one_camera(workload.batch.cameras, 0), theta.new_zeros(1, 3)

    def once(lap: Lap) -> None:
        with using_threads(1):  # as `Avatar.picture_renderer` does
            vertices = avatar.carrier_vertices(theta)
            lap("head")
            psi = avatar.weights(theta)
            lap("network")
        renderer = avatar.picture_renderer(theta, camera, psi, vertices)
        if renderer is None:
            renderer = avatar.renderer(theta, camera, psi, vertices)
        lap("prepare")
        assert renderer is not None
        renderer.draw(background, with_depth=False)
        lap("draw")

    parts = stopwatch.laps("parts", once)
    del parts[WHOLE]
    return parts


def _report(
    workload: AvatarWorkload,
    facts: dict[str, Any],
    spread: dict[str, Spread],
    growth_bytes: int | None,
) -> Report:
    theta, cameras = workload.batch.theta, workload.batch.cameras
    gaussians = workload.avatar.gaussians(theta)
    pairs = count_pairs(gaussians, cameras) / len(theta)
    whole_ms, eager = spread[WHOLE_FRAME].median_ms, spread[EAGER_FRAME]
    one = workload.avatar.gaussians(theta[:1])
    works = [
        rasterizer_work(round(pairs), one, one_camera(cameras, 0), backward=False),
        parameter_work(parameters_of(workload.avatar)),
    ]
    return Report(
        benchmark="render",
        workload=facts,
        images_per_second=1e3 / whole_ms,
        frames_per_second=1e3 / whole_ms,
        forward_ms_per_image=whole_ms,
        spread=spread,
        bytes_per_image=growth_bytes,
        roofline=roofline_figures(works, measure_speed(theta.device), 1, whole_ms, pairs),
        peers={
            EAGER_FRAME: {
                "whole_ms_per_image": eager.median_ms,
                "ratio": eager.median_ms / whole_ms,
                "repetitions": eager.repetitions,
            }
        },
    )
