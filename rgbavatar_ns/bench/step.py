"""`rgbavatar bench step`: a whole training step, its parts, and nerfstudio's trainer beside it."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.composition import to_world
from rgbavatar_ns.avatar.fused_step import FusedStep
from rgbavatar_ns.avatar.losses import composite, l1_loss, random_backgrounds, rgba_to_float
from rgbavatar_ns.avatar.training import (
    TrainingBatch,
    TrainingOptions,
    make_optimizer,
    training_step,
)
from rgbavatar_ns.bench.drawing import leaf_gaussians
from rgbavatar_ns.bench.floor import floor_figures, measure_speed, rasterizer_work, update_work
from rgbavatar_ns.bench.machine import machine_facts, require_backend
from rgbavatar_ns.bench.options import StepOptions
from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.report import Report
from rgbavatar_ns.bench.timing import (
    PEAK_MEMORY_METHOD,
    WHOLE,
    Lap,
    Progress,
    Spread,
    Stopwatch,
    peak_growth_bytes,
    using_threads,
)
from rgbavatar_ns.bench.trainer import bench_trainer
from rgbavatar_ns.bench.workloads import AvatarWorkload, avatar_workload
from rgbavatar_ns.kernels import rasterize

WHOLE_STEP = "whole step"
EAGER_STEP = "whole step, eager"
COLOR_INITIALISATION = "(colour initialisation, when due)"


def bench_step(options: StepOptions, progress: Progress | None = None) -> Report:
    """Measure what the options say; raises UserError where that cannot be done here."""
    backend = require_backend()
    with using_threads(options.threads) as threads:
        workload = avatar_workload(options, options.batch)
        facts = workload.facts | {"backend": backend, "threads": threads}
        stopwatch = Stopwatch(options.repetitions, progress)
        whole, growth_bytes = time_step(workload, stopwatch)
        parts = time_parts(workload, stopwatch)
        eager_parts = time_eager_parts(workload, stopwatch)
        trainer = bench_trainer(options, progress) if options.trainer else None
        return _report(workload, facts, whole, parts, eager_parts, growth_bytes, trainer)


def time_step(
    workload: AvatarWorkload, stopwatch: Stopwatch
) -> tuple[dict[str, Spread], int | None]:
    """Times of `training_step` and its memory, and times of its eager path.

    Every repetition starts from the same parameters, so that all of them do the same work.
    """
    spreads, growth_bytes = {}, None
    for name, options in _variants().items():
        step = WholeStep(workload.avatar, workload.batch, options)
        step.run()  # Makes the optimiser's state, which later steps find.
        step.restore()
        if not spreads:
            growth_bytes = peak_growth_bytes(step.run)
        spreads[name] = stopwatch.time(name, step.run, step.restore)
        step.restore()
    return spreads, growth_bytes


def _variants() -> dict[str, TrainingOptions]:
    """Options of the step as training takes it, and of the eager one."""
    return {
        WHOLE_STEP: TrainingOptions(color_init=None),
        EAGER_STEP: TrainingOptions(color_init=None, fast=False),
    }


class WholeStep:
    """One training step that can be taken again from the same parameters."""

    def __init__(self, avatar: Avatar, batch: TrainingBatch, options: TrainingOptions) -> None:
        self._avatar, self._batch, self._options = avatar, batch, options
        self.optimizer = make_optimizer(avatar)
        self._parameters = parameters_of(avatar)
        self._before = [parameter.detach().clone() for parameter in self._parameters]

    def run(self) -> None:
        """Take the step."""
        training_step(self._avatar, self.optimizer, self._batch, 0, self._options)

    @torch.no_grad()
    def restore(self) -> None:
        """Put the parameters back; the optimiser's moments stay, which changes no time."""
        for parameter, before in zip(self._parameters, self._before):
            parameter.copy_(before)


def parameters_of(avatar: Avatar) -> list[nn.Parameter]:
    """All that is trained."""
    return [parameter for group in avatar.parameter_groups().values() for parameter in group]


def _backward(tensors: tuple[Tensor, ...], gradients: tuple[Tensor, ...], inputs: Any) -> None:
    torch.autograd.grad(tensors, inputs, gradients, retain_graph=True, allow_unused=True)


def time_parts(workload: AvatarWorkload, stopwatch: Stopwatch) -> dict[str, Spread]:
    """Times of the fused step's parts as they follow one another, and of what is due at times."""
    avatar, batch = workload.avatar, workload.batch
    whole = WholeStep(avatar, batch, TrainingOptions(color_init=None))
    background, images = random_backgrounds(0, len(batch.theta)), torch.as_tensor(batch.images_rgba)

    def once(lap: Lap) -> None:
        step = FusedStep(avatar, [whole.optimizer])
        psi = avatar.weights(batch.theta)
        lap("network")
        with torch.no_grad():
            vertices = avatar.head(batch.theta, avatar.identity)
        lap("head")
        renderer = avatar.renderer(batch.theta, batch.cameras, psi.detach(), vertices)
        lap("prepare")
        assert renderer is not None
        renderer.compare(images, background)
        lap("compare")
        weight_gradient = step.update_gaussians(renderer).weights
        lap("update")
        step.update_network(psi, weight_gradient)
        lap("network, backward and Adam")

    parts = stopwatch.laps("parts", once, whole.restore)
    whole.restore()
    parts = {name: part for name, part in parts.items() if name != WHOLE}
    initialized = avatar.color_initialized.clone()
    parts[COLOR_INITIALISATION] = stopwatch.time(
        COLOR_INITIALISATION, lambda: avatar.initialize_colors(batch.theta, batch.cameras, images)
    )
    whole.restore()
    avatar.color_initialized.copy_(initialized)
    return parts


def time_eager_parts(workload: AvatarWorkload, stopwatch: Stopwatch) -> dict[str, Spread]:
    """Times of the eager step's parts, one after another on the tensors of a real step.

    Their sum can differ a little from the whole.
    """
    avatar, batch = workload.avatar, workload.batch
    optimizer = make_optimizer(avatar)
    background = random_backgrounds(0, len(batch.theta))
    psi = avatar.weights(batch.theta)
    tangent = avatar.blendshapes.blend(psi)
    ratio = avatar.config.scale_with_triangle
    with torch.no_grad():
        vertices = avatar.head(batch.theta, avatar.identity)
        frames = avatar.anchors.frames(vertices, with_length_ratio=ratio)
    blended = (tangent.position, tangent.rotation_wxyz, tangent.color_feature)
    world = to_world(tangent, frames)
    outputs = tuple(vars(world).values())
    leaf = leaf_gaussians(world)
    image = rasterize(leaf, batch.cameras, background).image
    target = composite(rgba_to_float(batch.images_rgba), background)
    seen = image.detach().requires_grad_()
    loss = l1_loss(seen, target)
    (image_gradient,) = torch.autograd.grad(loss, seen, retain_graph=True)
    inner, outer = (tuple(torch.rand_like(x) for x in group) for group in (blended, outputs))
    leaves, parameters = tuple(vars(leaf).values()), parameters_of(avatar)
    shared = (tangent.log_scale, tangent.opacity_logit)
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    no_grad: Callable[[Callable[[], Any]], Callable[[], Any]] = torch.no_grad()
    parts: dict[str, Callable[[], Any]] = {
        "weights": lambda: avatar.weights(batch.theta),
        "blend": lambda: avatar.blendshapes.blend(psi),
        "head": no_grad(lambda: avatar.head(batch.theta, avatar.identity)),
        "frames": no_grad(lambda: avatar.anchors.frames(vertices, with_length_ratio=ratio)),
        "to world": lambda: to_world(tangent, frames),
        "rasterize": lambda: rasterize(leaf, batch.cameras, background),
        "target": no_grad(lambda: composite(rgba_to_float(batch.images_rgba), background)),
        "loss": lambda: l1_loss(seen, target),
        "loss, backward": lambda: _backward((loss,), (torch.ones(()),), seen),
        "rasterize, backward": lambda: _backward((image,), (image_gradient,), leaves),
        "to world, backward": lambda: _backward(outputs, outer, (*blended, *shared)),
        "blend and weights, backward": lambda: _backward(blended, inner, parameters),
        "Adam": optimizer.step,
    }
    spreads = {name: stopwatch.time(f"eager: {name}", part) for name, part in parts.items()}
    for parameter in parameters:
        parameter.grad = None
    return spreads


def _report(
    workload: AvatarWorkload,
    facts: dict[str, Any],
    whole: dict[str, Spread],
    parts: dict[str, Spread],
    eager_parts: dict[str, Spread],
    growth_bytes: int | None,
    trainer: dict[str, Any] | None,
) -> Report:
    batch = len(workload.batch.theta)
    whole_ms = whole[WHOLE_STEP].median_ms
    peers = {
        name: {
            "whole_ms_per_image": spread.median_ms / batch,
            "images_per_second": 1e3 * batch / spread.median_ms,
            "ratio": spread.median_ms / whole_ms,
            "threads": facts["threads"],
            "repetitions": spread.repetitions,
            "parts": {part: times.median_ms for part, times in eager_parts.items()},
        }
        for name, spread in whole.items()
        if name != WHOLE_STEP
    }
    with torch.no_grad():
        gaussians = workload.avatar.gaussians(workload.batch.theta)
    cameras = workload.batch.cameras
    pairs = count_pairs(gaussians, cameras)
    works = [
        rasterizer_work(pairs, gaussians, cameras, backward=True),
        update_work(parameters_of(workload.avatar), torch.as_tensor(workload.batch.images_rgba)),
    ]
    spread = whole | parts | {f"eager: {name}": part for name, part in eager_parts.items()}
    return Report(
        benchmark="step",
        workload=facts,
        forward_ms_per_image=eager_parts["rasterize"].median_ms / batch,
        backward_ms_per_image=eager_parts["rasterize, backward"].median_ms / batch,
        images_per_second=1e3 * batch / whole_ms,
        frames_per_second=None,
        parts={name: part.median_ms for name, part in spread.items()},
        spread=spread,
        pairs={"per_image": pairs / batch, "per_second": 1e3 * pairs / whole_ms},
        memory={
            "bytes_per_image": None if growth_bytes is None else growth_bytes // batch,
            "method": PEAK_MEMORY_METHOD,
        },
        floor=floor_figures(works, measure_speed(), batch, whole_ms / batch),
        peers=peers,
        machine=machine_facts(),
        trainer=trainer,
    )
