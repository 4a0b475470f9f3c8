"""`rgbavatar bench step`: a whole training step, its parts, and nerfstudio's trainer beside it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rgbavatar_ns.avatar.model.tangent_to_world import tangent_to_world
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.loop import TrainingOptions, make_optimizer
from rgbavatar_ns.avatar.training.losses import l1_loss, random_backgrounds
from rgbavatar_ns.bench.drawing import leaf_gaussians
from rgbavatar_ns.bench.machine import chosen_device, machine_facts, require_backend
from rgbavatar_ns.bench.options import Scheme, StepOptions
from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.report import Report
from rgbavatar_ns.bench.roofline import (
    measure_speed,
    rasterizer_work,
    roofline_figures,
    update_work,
)
from rgbavatar_ns.bench.schemes import (
    EAGER_STEP,
    UNRECORDED_STEP,
    WHOLE_STEP,
    WholeStep,
    parameters_of,
    steps_of,
)
from rgbavatar_ns.bench.timing import (
    WHOLE,
    Lap,
    Progress,
    Spread,
    Stopwatch,
    peak_growth_bytes,
    peak_memory_method,
    using_threads,
    waiting_for,
)
from rgbavatar_ns.bench.trainer import bench_trainer
from rgbavatar_ns.bench.utilisation import Utilisation, gpu_utilisation
from rgbavatar_ns.bench.workloads import AvatarWorkload, avatar_workload
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float
from rgbavatar_ns.kernels import rasterize

COLOR_INITIALISATION = "(colour initialisation, when due)"


def bench_step(options: StepOptions, progress: Progress | None = None) -> Report:
    """Measure what the options say; raises UserError where that cannot be done here."""
    device = chosen_device(options.device)
    backend = require_backend("auto", device)
    with using_threads(options.threads) as threads:
        workload = avatar_workload(options, options.batch, device=device)
        facts = workload.facts | {"backend": backend, "threads": threads, "scheme": options.scheme}
        stopwatch = Stopwatch(options.repetitions, progress, wait=waiting_for(device))
        whole = time_step(workload, stopwatch, options.scheme)
        parts: dict[str, Spread] = {}
        eager_parts: dict[str, Spread] = {}
        if options.scheme == "batch-parallel":
            parts = time_parts(workload, stopwatch)
            eager_parts = time_eager_parts(workload, stopwatch)
        trainer = bench_trainer(options, device, progress) if options.trainer else None
        return _report(workload, facts, whole, parts, eager_parts, trainer)


@dataclass(frozen=True)
class StepTimes:
    """A scheme's times and those beside it, by name; its memory, and the share of a GPU in use."""

    spreads: dict[str, Spread]
    growth_bytes: int | None
    utilisation: Utilisation


def time_step(
    workload: AvatarWorkload, stopwatch: Stopwatch, scheme: Scheme = "batch-parallel"
) -> StepTimes:
    """Time a scheme's step and those beside it.

    Every repetition starts from the same parameters, so that all of them do the same work.
    """
    device = workload.batch.theta.device
    spreads: dict[str, Spread] = {}
    growth_bytes, utilisation = None, Utilisation(None, None)
    kinds = steps_of(scheme, workload.avatar, workload.batch)
    for name, make in kinds.items():
        step = make()
        step.run()  # Makes the optimiser's state, which later steps find.
        step.restore()
        # What a recorded step needs was taken when it was recorded.
        if name == (UNRECORDED_STEP if UNRECORDED_STEP in kinds else WHOLE_STEP):
            growth_bytes = peak_growth_bytes(step.run, device)
        spreads[name] = stopwatch.time(name, step.run, step.restore)
        if name == WHOLE_STEP:
            utilisation = gpu_utilisation(step.run, device)
        step.restore()
    return StepTimes(spreads, growth_bytes, utilisation)


def _backward(tensors: tuple[Tensor, ...], gradients: tuple[Tensor, ...], inputs: Any) -> None:
    torch.autograd.grad(tensors, inputs, gradients, retain_graph=True, allow_unused=True)


def time_parts(workload: AvatarWorkload, stopwatch: Stopwatch) -> dict[str, Spread]:
    """Times of the fused step's parts as they follow one another, and of what is due at times."""
    avatar, batch = workload.avatar, workload.batch
    whole = WholeStep(avatar, batch, TrainingOptions(color_init=None))
    background = random_backgrounds(0, len(batch.theta)).to(batch.theta.device)
    images = torch.as_tensor(batch.images_rgba)

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
        renderer.forward_loss(images, background)
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
    background = random_backgrounds(0, len(batch.theta)).to(batch.theta.device)
    psi = avatar.weights(batch.theta)
    tangent = avatar.blendshapes.morph(psi)
    ratio = avatar.config.scale_with_triangle
    with torch.no_grad():
        vertices = avatar.head(batch.theta, avatar.identity)
        frames = avatar.anchors.frames(vertices, with_length_ratio=ratio)
    blended = (tangent.position, tangent.rotation_wxyz, tangent.color_feature)
    world = tangent_to_world(tangent, frames)
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
        "blend": lambda: avatar.blendshapes.morph(psi),
        "head": no_grad(lambda: avatar.head(batch.theta, avatar.identity)),
        "frames": no_grad(lambda: avatar.anchors.frames(vertices, with_length_ratio=ratio)),
        "to world": lambda: tangent_to_world(tangent, frames),
        "rasterize": lambda: rasterize(leaf, batch.cameras, background),
        "target": no_grad(lambda: composite(rgba_to_float(batch.images_rgba), background)),
        "loss": lambda: l1_loss(seen, target),
        "loss, backward": lambda: _backward((loss,), (torch.ones_like(loss),), seen),
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
    times: StepTimes,
    parts: dict[str, Spread],
    eager_parts: dict[str, Spread],
    trainer: dict[str, Any] | None,
) -> Report:
    batch = len(workload.batch.theta)
    whole, growth_bytes = times.spreads, times.growth_bytes
    whole_ms, device = whole[WHOLE_STEP].median_ms, workload.batch.theta.device
    rasterizer = [eager_parts.get(name) for name in ("rasterize", "rasterize, backward")]
    forward_ms, backward_ms = (part and part.median_ms / batch for part in rasterizer)
    peers = {
        name: {
            "whole_ms_per_image": spread.median_ms / batch,
            "images_per_second": 1e3 * batch / spread.median_ms,
            "ratio": spread.median_ms / whole_ms,
            "threads": facts["threads"],
            "repetitions": spread.repetitions,
            "parts": {part: s.median_ms for part, s in eager_parts.items() if name == EAGER_STEP},
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
        forward_ms_per_image=forward_ms,
        backward_ms_per_image=backward_ms,
        images_per_second=1e3 * batch / whole_ms,
        frames_per_second=None,
        parts={name: part.median_ms for name, part in spread.items()},
        spread=spread,
        pairs={"per_image": pairs / batch, "per_second": 1e3 * pairs / whole_ms},
        memory={
            "bytes_per_image": None if growth_bytes is None else growth_bytes // batch,
            "method": peak_memory_method(device),
        },
        floor=roofline_figures(works, measure_speed(device), batch, whole_ms / batch),
        peers=peers,
        machine=machine_facts(),
        trainer=trainer,
        gpu_utilisation_percent=times.utilisation.percent,
        gpu_utilisation_note=times.utilisation.note,
    )
