"""`rgbavatar bench step`: a whole training step, its parts, and nerfstudio's trainer beside it."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.training import (
    TrainingBatch,
    TrainingOptions,
    TrainingStep,
    make_optimizer,
)
from rgbavatar_ns.avatar.training.batches import ChosenFrames, DeviceFrames
from rgbavatar_ns.avatar.training.color_init import FirstColors
from rgbavatar_ns.avatar.training.cuda_graph import Recorder, record_cuda_graph
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.bench.machine import chosen_device, require_backend
from rgbavatar_ns.bench.options import StepOptions
from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.report import Report
from rgbavatar_ns.bench.roofline import (
    measure_speed,
    rasterizer_work,
    roofline_figures,
    update_work,
)
from rgbavatar_ns.bench.timing import (
    WHOLE,
    Lap,
    Progress,
    Spread,
    Stopwatch,
    peak_growth_bytes,
)
from rgbavatar_ns.bench.trainer import bench_trainer
from rgbavatar_ns.bench.workloads import AvatarWorkload, avatar_workload, parameters_of
from rgbavatar_ns.threads import using_threads

WHOLE_STEP = "whole step"
EAGER_STEP = "whole step, eager"
UNRECORDED_STEP = "whole step, without the CUDA graph"
FIRST_COLORS = "(forward and loss, looking for first colours)"

Take = Callable[[], Float[Tensor, ""]]
"""Trains on a batch once and returns the loss."""


def bench_step(options: StepOptions, progress: Progress | None = None) -> Report:
    """Measure what the options say; raises UserError where that cannot be done here."""
    device = chosen_device(options.device)
    backend = require_backend("auto", device)
    with using_threads(options.threads) as threads:
        workload = avatar_workload(options, options.batch, device=device)
        facts = workload.facts | {"backend": backend, "threads": threads}
        stopwatch = Stopwatch(options.repetitions, progress)
        whole, growth_bytes = time_step(workload, stopwatch)
        parts = time_parts(workload, stopwatch)
        trainer = bench_trainer(options, device, progress) if options.trainer else None
        return _report(workload, facts, whole, parts, growth_bytes, trainer)


class StartingPoint:
    """The parameters as they were; the optimiser's moments stay, which changes no time."""

    def __init__(self, avatar: Avatar) -> None:
        self._parameters = parameters_of(avatar)
        self._before = [parameter.detach().clone() for parameter in self._parameters]

    @torch.no_grad()
    def restore(self) -> None:
        """Put them back."""
        for parameter, before in zip(self._parameters, self._before):
            parameter.copy_(before)


def time_step(
    workload: AvatarWorkload, stopwatch: Stopwatch
) -> tuple[dict[str, Spread], int | None]:
    """Time the fastest step that there is here and those beside it; and the memory of one.

    Every repetition starts from the same parameters, so that all of them do the same work.
    """
    avatar, batch = workload.avatar, workload.batch
    kinds = {
        WHOLE_STEP: lambda: step_by_step(avatar, batch, fast=True),
        EAGER_STEP: lambda: step_by_step(avatar, batch, fast=False),
    }
    measured = WHOLE_STEP
    if batch.theta.device.type == "cuda":
        # What a CUDA graph needs was taken when it was recorded.
        measured, kinds[UNRECORDED_STEP] = UNRECORDED_STEP, kinds[WHOLE_STEP]
        kinds[WHOLE_STEP] = lambda: recorded_step(avatar, batch)
    start, growth_bytes, spreads = StartingPoint(avatar), None, {}
    for name, make in kinds.items():
        take = make()
        take()  # Makes the optimiser's state, which later steps find.
        start.restore()
        if name == measured:
            growth_bytes = peak_growth_bytes(take, batch.theta.device)
        spreads[name] = stopwatch.time(name, take, start.restore)
        start.restore()
    return spreads, growth_bytes


def step_by_step(avatar: Avatar, batch: TrainingBatch, *, fast: bool) -> Take:
    """A step by the backend's loops, or through autograd."""
    step = TrainingStep(
        avatar, options=TrainingOptions(first_colors=None, surface_prior=False, fast=fast)
    )
    return lambda: step(batch, 0)["l1"]


def recorded_step(
    avatar: Avatar, batch: TrainingBatch, recorder: Recorder = record_cuda_graph
) -> Take:
    """A step as one CUDA graph, which is recorded when this is made."""
    start = StartingPoint(avatar)
    frames = DeviceFrames(batch.theta, batch.cameras, torch.as_tensor(batch.images_rgba))
    count = len(batch.theta)
    options = TrainingOptions(first_colors=None, surface_prior=False)
    step = TrainingStep(avatar, options=options, frames=lambda: frames, recorder=recorder)
    chosen = ChosenFrames(list(range(count)), random_backgrounds(0, count))
    for _ in range(8):
        step(chosen, 0)
    start.restore()
    return lambda: step(chosen, 0)["l1"]


def time_parts(workload: AvatarWorkload, stopwatch: Stopwatch) -> dict[str, Spread]:
    """Times of the fused step's parts as they follow one another, and of what is due at times."""
    avatar, batch = workload.avatar, workload.batch
    start, optimizer = StartingPoint(avatar), make_optimizer(avatar)
    background = random_backgrounds(0, len(batch.theta)).to(batch.theta.device)
    images = torch.as_tensor(batch.images_rgba)

    def once(lap: Lap) -> None:
        step = FusedStep(avatar, [optimizer])
        psi = avatar.weights(batch.theta)
        lap("network")
        with torch.no_grad():
            vertices = avatar.head(batch.theta, avatar.identity)
        lap("head")
        renderer = avatar.renderer(batch.theta, batch.cameras, psi.detach(), vertices)
        lap("prepare")
        assert renderer is not None
        renderer.forward_loss(images, background)
        lap("forward and loss")
        weight_gradient = step.update_gaussians(renderer).weights
        lap("backward and Adam")
        step.update_network(psi, weight_gradient)
        lap("network, backward and Adam")

    parts = stopwatch.laps("parts", once, start.restore)
    start.restore()
    del parts[WHOLE]
    # What this batch shows has its colour; what it hides waits, as in most of a run.
    initialized, colors = avatar.color_initialized.clone(), FirstColors(avatar)
    renderer = avatar.renderer(batch.theta, batch.cameras)
    assert renderer is not None
    sight = colors.sight(len(batch.theta))
    assert sight is not None
    renderer.forward_loss(images, background, sight)
    colors.give(sight)
    parts[FIRST_COLORS] = stopwatch.time(
        FIRST_COLORS, lambda: renderer.forward_loss(images, background, sight)
    )
    start.restore()
    avatar.color_initialized.copy_(initialized)
    return parts


def _report(
    workload: AvatarWorkload,
    facts: dict[str, Any],
    whole: dict[str, Spread],
    parts: dict[str, Spread],
    growth_bytes: int | None,
    trainer: dict[str, Any] | None,
) -> Report:
    batch, device = len(workload.batch.theta), workload.batch.theta.device
    whole_ms = whole[WHOLE_STEP].median_ms
    with torch.no_grad():
        gaussians = workload.avatar.gaussians(workload.batch.theta)
    cameras = workload.batch.cameras
    pairs = count_pairs(gaussians, cameras)
    works = [
        rasterizer_work(pairs, gaussians, cameras, backward=True),
        update_work(parameters_of(workload.avatar), torch.as_tensor(workload.batch.images_rgba)),
    ]
    speed = measure_speed(device)
    return Report(
        benchmark="step",
        workload=facts,
        images_per_second=1e3 * batch / whole_ms,
        spread=whole | parts,
        bytes_per_image=None if growth_bytes is None else growth_bytes // batch,
        roofline=roofline_figures(works, speed, batch, whole_ms / batch, pairs / batch),
        peers={
            name: {
                "whole_ms_per_image": spread.median_ms / batch,
                "images_per_second": 1e3 * batch / spread.median_ms,
                "ratio": spread.median_ms / whole_ms,
                "repetitions": spread.repetitions,
            }
            for name, spread in whole.items()
            if name != WHOLE_STEP
        },
        trainer=trainer,
    )
