"""Time one training step by part, on the embedded head and random pictures.

    python benchmarks/training_step.py [--uv 128 256] [--image 256 512] [--repeats 7]

Prints medians in milliseconds for a batch of ten; `--json PATH` also writes them, with the
machine. The parts are timed one after another on the tensors of a real step, so their sum can
differ a little from the whole.
"""

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.composition import to_world
from rgbavatar_ns.avatar.losses import composite, l1_loss, random_backgrounds, rgba_to_float
from rgbavatar_ns.avatar.training import (
    TrainingBatch,
    TrainingOptions,
    make_optimizer,
    training_step,
)
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, available_backends, rasterize

BATCH = 10


@dataclass(frozen=True)
class Setting:
    """One row of the table."""

    uv_resolution: int
    image_px: int


def make_batch(avatar: Avatar, image_px: int) -> TrainingBatch:
    """A front view that the head fills by about two thirds, with random pictures."""
    generator = torch.Generator().manual_seed(0)
    vertices = avatar.head.arrays.v_template
    middle = torch.from_numpy((vertices.max(0) + vertices.min(0)) / 2).float()
    height_m = float(vertices[:, 1].max() - vertices[:, 1].min())
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ middle + torch.tensor([0, 0, 1.0])
    cameras = PinholeCameras(
        world_to_camera=world_to_camera[None],
        focal_px=torch.full((1, 2), 0.8 * image_px / height_m),
        principal_point_px=torch.full((1, 2), image_px / 2),
        width=image_px,
        height=image_px,
    )
    theta = 0.05 * torch.randn(BATCH, avatar.layout.size, generator=generator)
    shape = (BATCH, image_px, image_px, 4)
    images = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
    return TrainingBatch(theta, cameras, images)


def median_ms(part: Callable[[], Any], repeats: int) -> float:
    """The median time of a part, after one warm-up."""
    part()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        part()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def _leaf(gaussians: GaussianSet) -> GaussianSet:
    """The same Gaussians as leaves, to time the rasterizer's backward pass alone."""
    names = ("means", "quats_wxyz", "scales", "opacities", "colors")
    return GaussianSet(**{n: getattr(gaussians, n).detach().requires_grad_() for n in names})


def _backward(tensors: tuple[Tensor, ...], gradients: tuple[Tensor, ...], inputs: Any) -> None:
    torch.autograd.grad(tensors, inputs, gradients, retain_graph=True, allow_unused=True)


def time_parts(avatar: Avatar, batch: TrainingBatch, repeats: int) -> dict[str, float]:
    """Milliseconds a part, forward and backward apart where both matter."""
    optimizer = make_optimizer(avatar)
    options = TrainingOptions(color_init=None)
    background = random_backgrounds(0, BATCH)
    step = iter(range(10**9))
    whole = median_ms(lambda: training_step(avatar, optimizer, batch, next(step), options), repeats)
    parameters = [p for group in avatar.parameter_groups().values() for p in group]

    psi = avatar.weights(batch.theta)
    tangent = avatar.blendshapes.blend(psi)
    with torch.no_grad():
        vertices = avatar.head(batch.theta, avatar.identity)
        frames = avatar.anchors.frames(vertices)
    blended = (tangent.position, tangent.rotation_wxyz, tangent.color_feature)
    world = to_world(tangent, frames)
    outputs = (world.means, world.quats_wxyz, world.scales, world.opacities, world.colors)
    leaf = _leaf(world)
    image = rasterize(leaf, batch.cameras, background).image
    target = composite(rgba_to_float(batch.images_rgba), background)
    seen = image.detach().requires_grad_()
    loss = l1_loss(seen, target)
    (image_gradient,) = torch.autograd.grad(loss, seen, retain_graph=True)
    inner = tuple(torch.rand_like(x) for x in blended)
    outer = tuple(torch.rand_like(x) for x in outputs)
    leaves = (leaf.means, leaf.quats_wxyz, leaf.scales, leaf.opacities, leaf.colors)

    def forward(part: Callable[[], Any]) -> Callable[[], Any]:
        return torch.no_grad()(part)

    parts: dict[str, Callable[[], Any]] = {
        "psi": lambda: avatar.weights(batch.theta),
        "blend": lambda: avatar.blendshapes.blend(psi),
        "head": forward(lambda: avatar.head(batch.theta, avatar.identity)),
        "frames": forward(lambda: avatar.anchors.frames(vertices)),
        "to world": lambda: to_world(tangent, frames),
        "rasterize": lambda: rasterize(leaf, batch.cameras, background),
        "target": forward(lambda: composite(rgba_to_float(batch.images_rgba), background)),
        "loss": lambda: l1_loss(seen, target),
        "loss, backward": lambda: _backward((loss,), (torch.ones(()),), seen),
        "rasterize, backward": lambda: _backward((image,), (image_gradient,), leaves),
        "to world, backward": lambda: _backward(outputs, outer, blended),
        "blend + psi, backward": lambda: _backward(blended, inner, parameters),
        "Adam": optimizer.step,
    }
    times = {name: median_ms(part, repeats) for name, part in parts.items()}
    times["whole step"] = whole
    times["images/s"] = 1e3 * BATCH / whole
    images = rgba_to_float(batch.images_rgba)
    times["(colour initialisation, when due)"] = median_ms(
        lambda: avatar.initialize_colors(batch.theta, batch.cameras, images), repeats
    )
    return times


def main() -> None:
    """Time all settings and print them as a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--uv", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--image", type=int, nargs="+", default=[256, 512])
    parser.add_argument("--bases", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    head, columns = HeadModel.embedded(), {}
    for uv_resolution in arguments.uv:
        config = AvatarConfig(num_bases=arguments.bases, uv_resolution=uv_resolution)
        avatar = Avatar(head, torch.zeros(head.num_identity), config)
        for image_px in arguments.image:
            name = f"{avatar.num_gaussians // 1000}k @ {image_px}"
            columns[name] = time_parts(avatar, make_batch(avatar, image_px), arguments.repeats)
    print(f"backend {available_backends()[0]}, {torch.get_num_threads()} threads; ms, batch 10")
    print(f"{'':34}" + "".join(f"{name:>12}" for name in columns))
    for part in next(iter(columns.values())):
        print(f"{part:34}" + "".join(f"{times[part]:12.1f}" for times in columns.values()))
    if arguments.json:
        machine = {
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "backends": available_backends(),
        }
        arguments.json.write_text(json.dumps({"machine": machine, "ms": columns}, indent=1))


if __name__ == "__main__":
    main()
