"""Timing of anything that draws Gaussians: forward, backward, memory."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.bench.timing import WHOLE, Lap, Spread, Stopwatch, peak_growth_bytes
from rgbavatar_ns.kernels import GaussianSet

Draw = Callable[[GaussianSet], Float[Tensor, "B H W 3"]]


@dataclass(frozen=True)
class DrawTimes:
    """Times of a batch; `forward` keeps what the backward needs."""

    forward: Spread
    backward: Spread
    whole: Spread
    growth_bytes: int | None
    """Memory of the first forward and backward (see `timing.peak_memory_method`)."""


def leaf_gaussians(gaussians: GaussianSet) -> GaussianSet:
    """The same Gaussians as leaves that ask for gradients."""
    return GaussianSet(
        **{name: value.detach().requires_grad_() for name, value in vars(gaussians).items()}
    )


def time_draw(
    what: str,
    draw: Draw,
    gaussians: GaussianSet,
    image_shape: tuple[int, int, int, int],
    stopwatch: Stopwatch,
) -> DrawTimes:
    """Time forward and backward to all attributes, from a random gradient of the image."""
    leaves = leaf_gaussians(gaussians)
    generator = torch.Generator().manual_seed(1)
    image_grad = torch.randn(image_shape, generator=generator) / image_shape[1] ** 2
    image_grad = image_grad.to(gaussians.means.device)

    def once(lap: Lap) -> None:
        for leaf in vars(leaves).values():
            leaf.grad = None
        image = draw(leaves)
        lap("forward")
        image.backward(image_grad)
        lap("backward")

    growth_bytes = peak_growth_bytes(lambda: once(lambda name: None), gaussians.means.device)
    spread = stopwatch.laps(what, once)
    return DrawTimes(spread["forward"], spread["backward"], spread[WHOLE], growth_bytes)
