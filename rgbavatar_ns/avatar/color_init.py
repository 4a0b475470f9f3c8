"""Colour initialisation: a Gaussian's first colour is the mean of the pixels it covers.

Paper, sec. 3.2: c = sum w I / sum w, once for each Gaussian, when its splatting weight w (alpha
times transmittance, the blending weight of the pixel) first exceeds .1.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, weighted_color_average

WEIGHT_THRESHOLD = 0.1
"""The blending weight that a Gaussian must exceed in some pixel (paper: .1; its release: .01)."""

_SMALLEST_MATTE_SUM = 1e-3
"""Below this sum of weight times alpha a Gaussian saw background only."""


@dataclass(frozen=True)
class ColorEstimate:
    """Colours of N Gaussians and which of them are seen well enough to trust."""

    color: Float[Tensor, "N 3"]
    reliable: Bool[Tensor, "N"]


@dataclass(frozen=True)
class ColorInitSchedule:
    """After which optimiser steps colours are initialised.

    The estimate costs about half a training step. Nearly all Gaussians that the data shows are
    seen in the first steps, so it runs after each of the first `every_step_until` steps and then
    after every `interval`-th one, which adds about 2 % to a long run; once every Gaussian has its
    colour it stops. Ours: the paper does not say how often.
    """

    every_step_until: int = 20
    interval: int = 25

    def due(self, step: int) -> bool:
        """Say whether colours are initialised after step `step` (counted from 0)."""
        return step < self.every_step_until or step % self.interval == 0


@torch.no_grad()
def estimate_colors(
    gaussians: GaussianSet, cameras: PinholeCameras, images_rgba: Float[Tensor, "B H W 4"]
) -> ColorEstimate:
    """Average the straight-alpha images under each Gaussian, summed over the batch.

    Each pixel also counts by its matte alpha: c = sum w a I / sum w a. Ours, because a pixel of
    the matted-out background has no colour of the head; what stands there (black, or a random
    colour in training) would tint the silhouette. With alpha 1 everywhere it is the paper's sum.
    """
    alpha = images_rgba[..., 3:]
    premultiplied = torch.cat((images_rgba[..., :3] * alpha, alpha), dim=-1)
    sums = weighted_color_average(gaussians, cameras, premultiplied)
    total = sums.weighted_sum.sum(0)
    matte_sum = total[:, 3:]
    return ColorEstimate(
        color=total[:, :3] / matte_sum.clamp(min=_SMALLEST_MATTE_SUM),
        reliable=(sums.max_weight.amax(0) > WEIGHT_THRESHOLD)
        & (matte_sum.squeeze(-1) > _SMALLEST_MATTE_SUM),
    )
