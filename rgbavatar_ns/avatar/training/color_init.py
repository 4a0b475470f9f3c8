"""Colour initialisation: a Gaussian's first colour is the mean of the pixels it covers.

Paper, sec. 3.2: c = sum w I / sum w, once for each Gaussian, when its splatting weight w (alpha
times transmittance, the blending weight of the pixel) first exceeds .1. Every step looks: what it
draws is summed for the Gaussians that still wait, and those that it shows well are given their
colour after it.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import feature_from_color
from rgbavatar_ns.avatar.training.losses import require_images_of
from rgbavatar_ns.drawing.compositing import ImagesRGBA, is_unfilmed, rgba_to_float
from rgbavatar_ns.kernels import (
    FirstSight,
    GaussianSet,
    PinholeCameras,
    WeightedColors,
    weighted_color_average,
)
from rgbavatar_ns.kernels.types import SIGHT_SUMS, SIGHT_UNIT

FirstColorsKind = Literal["matted", "paper"]
"""paper: I is the training picture over its background. matted: each pixel counts by its matte
alpha a too, c = sum w a I / sum w a, and a colour that was learned from fainter sights stays. Ours,
because what lies behind the person tints the silhouette else, and late means undo what was learned
(docs/paper.md)."""

WEIGHT_THRESHOLD = 0.1
"""The blending weight that a Gaussian must exceed in some pixel (paper: .1; its release: .01)."""
_THRESHOLD_UNITS = int(WEIGHT_THRESHOLD / SIGHT_UNIT)
_LEARNED = 0.06
"""A colour feature that is so far from its initial grey was learned: five of Adam's steps."""
_HIDDEN_LOGIT = -12.0
"""An opacity of 6e-6, far below what is drawn."""
_SMALLEST_WEIGHT_SUM = 1e-3
"""Below this sum of counted weights a Gaussian saw background only."""


class FirstColors:
    """Gives an avatar's Gaussians their first colours, each once; `color_initialized` remembers.

    Only base colours change; optimiser state stays.
    """

    def __init__(self, avatar: Avatar, kind: FirstColorsKind = "matted") -> None:
        self._avatar = avatar
        self._kind: FirstColorsKind = kind
        self._sums: Tensor | None = None
        # Those that wait, on a CPU as `sight` last found them, and in which state of the buffer.
        self._known: Tensor | None = None
        self._version = 0
        self._waiting: Tensor = torch.empty(0, dtype=torch.int64)

    def sight(self, num_images: int) -> FirstSight | None:
        """What a step is to sum over the first `num_images` of its pictures.

        None where no Gaussian waits, which is not asked of a GPU: the question would stop it. What
        it is summed in is the same memory each time, of which a CPU touches only what waits.
        """
        known = self._avatar.color_initialized
        if self._sums is None or self._sums.device != known.device:
            size = (len(known), SIGHT_SUMS)
            self._sums = torch.zeros(size, dtype=torch.int64, device=known.device)
        if known.device.type != "cpu":
            self._sums.zero_()
        else:
            if self._known is not known or self._version != known._version:
                self._known, self._version = known, known._version
                self._waiting = (~known).nonzero()[:, 0]
            if len(self._waiting) == 0:
                return None
            self._sums.index_fill_(0, self._waiting, 0)
        return FirstSight(known, self._sums, num_images, WEIGHT_THRESHOLD, self._kind == "paper")

    @torch.no_grad()
    def seen_in(
        self,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        images_rgba: ImagesRGBA,
        background: Float[Tensor, "B 3"],
        *,
        backend: str = "auto",
    ) -> Float[Tensor, "N 5"]:
        """The sums of `FirstSight`, of all Gaussians as they are now, by a pass of their own."""
        require_images_of(images_rgba, len(theta), cameras)
        avatar = self._avatar
        images = counted(images_rgba, background.to(theta), self._kind)
        images = images.to(avatar.blendshapes.position.dtype)
        renderer = avatar.renderer(theta, cameras, backend=backend)
        if renderer is not None:
            return _joined(renderer.weighted_color_average(images))
        gaussians = avatar.gaussians(theta)
        return _joined(weighted_color_average(gaussians, cameras, images, backend=backend))

    @torch.no_grad()
    def give(self, seen: FirstSight | Float[Tensor, "N 5"]) -> None:
        """Give those that wait, and were seen well, the mean colour under them.

        Waits for no device.
        """
        avatar = self._avatar
        if isinstance(seen, FirstSight):
            if seen.sums.device.type == "cpu":
                largest = seen.sums[self._waiting, 4].max()
                if int(largest) <= _THRESHOLD_UNITS:
                    return  # in most steps nothing new comes to light
            seen = seen.sums * SIGHT_UNIT
        sums, feature = seen, avatar.blendshapes.color_feature
        given = is_seen_well(sums) & ~avatar.color_initialized
        if given.device.type == "cpu" and not bool(given.any()):
            return
        avatar.color_initialized |= given
        if self._kind == "matted":
            grey = feature_from_color(feature.new_full((3,), avatar.config.initial_color))
            given = given & ((feature - grey).abs().amax(1) < _LEARNED)
        first = feature_from_color(mean_color(sums)).to(feature)
        feature.copy_(torch.where(given[:, None], first, feature))


@torch.no_grad()
def hide_unseen(avatar: Avatar) -> None:
    """Make the Gaussians transparent that never had a first colour (release, offline)."""
    avatar.blendshapes.opacity_logit[~avatar.color_initialized] = _HIDDEN_LOGIT


def is_seen_well(sums: Float[Tensor, "N 5"]) -> Tensor:
    """Whether the mean colour under each Gaussian can be trusted: [N], bool."""
    return (sums[:, 4] > WEIGHT_THRESHOLD) & (sums[:, 3] > _SMALLEST_WEIGHT_SUM)


def mean_color(sums: Float[Tensor, "N 5"]) -> Float[Tensor, "N 3"]:
    """The mean colour under each Gaussian."""
    return sums[:, :3] / sums[:, 3:4].clamp(min=_SMALLEST_WEIGHT_SUM)


def sums_of(
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    images_rgba: ImagesRGBA,
    background: Float[Tensor, "B 3"],
    kind: FirstColorsKind = "matted",
) -> Float[Tensor, "N 5"]:
    """As `FirstColors.seen_in`, of any Gaussians."""
    images = counted(images_rgba, background, kind).to(gaussians.means.dtype)
    return _joined(weighted_color_average(gaussians, cameras, images))


def counted(
    images_rgba: ImagesRGBA, background: Float[Tensor, "B 3"], kind: FirstColorsKind
) -> Float[Tensor, "B H W 4"]:
    """Straight-alpha images as what each pixel counts, its colour times its share, and the share.

    What nobody filmed counts for nothing.
    """
    images = rgba_to_float(images_rgba, background.dtype)
    matte = images[..., 3:]
    if kind == "matted":
        return torch.cat([images[..., :3] * matte, matte], -1)
    filmed = (~is_unfilmed(images_rgba))[..., None].to(images.dtype)
    behind = background[:, None, None]
    return torch.cat([filmed * torch.lerp(behind, images[..., :3], matte), filmed], -1)


def _joined(colors: WeightedColors) -> Float[Tensor, "N 5"]:
    """Over the batch: sums of colour and of share, and the largest weight."""
    return torch.cat([colors.weighted_sum.sum(0), colors.max_weight.amax(0)[:, None]], -1)
