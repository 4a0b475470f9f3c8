"""Colour initialisation: a Gaussian's first colour is the mean of the pixels it covers.

Paper, sec. 3.2: c = sum w I / sum w, once for each Gaussian, when its splatting weight w (alpha
times transmittance, the blending weight of the pixel) first exceeds .1.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import feature_from_color
from rgbavatar_ns.avatar.training.losses import require_images_of
from rgbavatar_ns.drawing.compositing import rgba_to_float
from rgbavatar_ns.kernels import (
    GaussianSet,
    PinholeCameras,
    WeightedColors,
    weighted_color_average,
)

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

    After each of the first `every_step_until` steps, in which nearly all Gaussians are seen, then
    after every `interval`-th one up to step `regular_until`, and from there at intervals that
    double (steps 200, 400, 800 ...). Ours: the paper does not say how often.
    """

    every_step_until: int = 20
    interval: int = 25
    regular_until: int = 100

    def due(self, step: int) -> bool:
        """Say whether colours are initialised after step `step` (counted from 0)."""
        if step < self.every_step_until:
            return True
        if step <= self.regular_until:
            return step % self.interval == 0
        times, rest = divmod(step, max(1, self.regular_until))
        return rest == 0 and times.bit_count() == 1


@torch.no_grad()
def estimate_colors(
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    images_rgba: UInt8[Tensor, "B H W 4"] | Float[Tensor, "B H W 4"],
) -> ColorEstimate:
    """Average the straight-alpha images under each Gaussian as `color_estimate`, over the batch."""
    images = premultiplied(images_rgba, gaussians.means.dtype)
    return color_estimate(weighted_color_average(gaussians, cameras, images))


def premultiplied(
    images_rgba: UInt8[Tensor, "B H W 4"] | Float[Tensor, "B H W 4"], dtype: torch.dtype
) -> Float[Tensor, "B H W 4"]:
    """Return straight-alpha images with their colour multiplied by alpha, as one new tensor."""
    images = rgba_to_float(images_rgba, dtype)
    if images is images_rgba:
        images = images.clone()
    images[..., :3] *= images[..., 3:]
    return images


def color_estimate(sums: WeightedColors) -> ColorEstimate:
    """Return the colours that follow from the sums over premultiplied RGBA images.

    Each pixel also counts by its matte alpha: c = sum w a I / sum w a. Ours, because what stands in
    the matted-out background would tint the silhouette. With alpha 1 it is the paper's sum.
    """
    total = sums.weighted_sum.sum(0)
    matte_sum = total[:, 3:]
    return ColorEstimate(
        color=total[:, :3] / matte_sum.clamp(min=_SMALLEST_MATTE_SUM),
        reliable=(sums.max_weight.amax(0) > WEIGHT_THRESHOLD)
        & (matte_sum.squeeze(-1) > _SMALLEST_MATTE_SUM),
    )


@torch.no_grad()
def initialize_colors(
    avatar: Avatar,
    theta: Float[Tensor, "B H"],
    cameras: PinholeCameras,
    images_rgba: UInt8[Tensor, "B H_px W_px 4"] | Float[Tensor, "B H_px W_px 4"],
    *,
    backend: str = "auto",
) -> int:
    """Give Gaussians seen well for the first time the mean colour under them; return how many.

    Paper, sec. 3.2. Only base colours change, and each Gaussian's only once, which the avatar's
    `color_initialized` remembers; optimiser state stays.
    """
    require_images_of(images_rgba, len(theta), cameras)
    images = premultiplied(images_rgba, avatar.blendshapes.position.dtype)
    renderer = avatar.renderer(theta, cameras, backend=backend)
    if renderer is not None:
        sums = renderer.weighted_color_average(images)
    else:
        sums = weighted_color_average(avatar.gaussians(theta), cameras, images, backend=backend)
    estimate = color_estimate(sums)
    fresh = estimate.reliable & ~avatar.color_initialized
    feature = avatar.blendshapes.color_feature
    feature[fresh] = feature_from_color(estimate.color[fresh]).to(feature.dtype)
    avatar.color_initialized |= fresh
    return int(fresh.sum())
