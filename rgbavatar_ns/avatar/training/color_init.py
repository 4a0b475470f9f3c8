"""Colour initialisation: a Gaussian's first colour is the mean of the pixels it covers.

Paper, sec. 3.2: c = sum w I / sum w, once for each Gaussian, when its splatting weight w (alpha
times transmittance, the blending weight of the pixel) first exceeds .1. Every step looks: what it
draws is summed for the Gaussians that still wait, and those that it shows well are given their
colour after it.
"""

from typing import Literal, TypeVar, cast

import numpy as np
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

_Sums = TypeVar("_Sums", Tensor, np.ndarray)
"""[N, 5]: counted colour, its weight, the largest weight."""

FirstColorsKind = Literal["matted", "paper"]
"""paper: I is the training picture over its background. matted: each pixel counts by its matte
alpha a too, c = sum w a I / sum w a, and a colour stays that was learned from fainter sights or
painted by the surface prior. Ours, because what lies behind the person tints the silhouette else,
and late means undo what was learned (docs/paper.md)."""

WEIGHT_THRESHOLD = 0.1
"""The blending weight that a Gaussian must exceed in some pixel (paper: .1; its release: .01)."""
_LEARNED = 0.06
"""A colour feature that is so far from its initial grey was learned: five of Adam's steps."""
_HIDDEN_LOGIT = -12.0
"""An opacity of 6e-6, far below what is drawn."""
CHANGED_AT_END = (
    "color_initialized",
    "blendshapes.color_feature",
    "blendshapes.opacity_logit",
)
"""What first colours that are given after the last step, and `hide_unseen`, change of an avatar."""
_SMALLEST_WEIGHT_SUM = 1e-3
"""Below this sum of counted weights a Gaussian saw background only."""


class FirstColors:
    """Gives an avatar's Gaussians their first colours, each once; `color_initialized` remembers.

    Only base colours change; optimiser state stays.
    """

    def __init__(self, avatar: Avatar, kind: FirstColorsKind = "matted") -> None:
        self._avatar = avatar
        self._kind: FirstColorsKind = kind
        self._grey = feature_from_color(avatar.config.initial_color)
        self._sums: Tensor | None = None
        self._last: FirstSight | None = None

    def sight(self, num_images: int) -> FirstSight | None:
        """What a step is to sum over the first `num_images` of its pictures.

        None where no Gaussian waits, which is not asked of a GPU: the question would stop it. What
        it is summed in is the same memory each time, cleared where it was filled.
        """
        known = self._avatar.color_initialized
        if self._sums is None or self._sums.device != known.device:
            size = (len(known), SIGHT_SUMS)
            self._sums = torch.zeros(size, dtype=torch.int64, device=known.device)
            self._last = None
        if known.device.type == "cpu" and known.numpy().all():
            return None
        if self._last is not None and self._last.shown is None:
            self._sums.zero_()
        elif self._last is not None:
            self._sums.numpy()[self._last.shown] = 0
        over_background = self._kind == "paper"
        self._last = FirstSight(known, self._sums, num_images, WEIGHT_THRESHOLD, over_background)
        return self._last

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
            if seen.shown is not None:
                return self._give_few(seen.sums.numpy(), np.array(seen.shown, np.int64))
            seen = seen.sums * SIGHT_UNIT
        feature = avatar.blendshapes.color_feature
        given = is_seen_well(seen) & ~avatar.color_initialized
        avatar.color_initialized |= given
        if self._kind == "matted":
            given = given & ((feature - self._grey).abs().amax(1) < _LEARNED)
        first = feature_from_color(mean_color(seen)).to(feature)
        feature.copy_(torch.where(given[:, None], first, feature))

    def _give_few(self, sums: np.ndarray, rows: np.ndarray) -> None:
        """As `give`, of the few rows that a step on a CPU shows first.

        Numpy, because twenty of torch's calls cost as much as a hundredth of the step.
        """
        if len(rows) == 0:
            return
        avatar, seen = self._avatar, sums[rows] * SIGHT_UNIT
        well = is_seen_well(seen)
        rows, seen = rows[well], seen[well]
        avatar.color_initialized.index_fill_(0, torch.from_numpy(rows), True)
        feature = avatar.blendshapes.color_feature
        if self._kind == "matted":
            grey = np.abs(feature.numpy()[rows] - self._grey).max(1) < _LEARNED
            rows, seen = rows[grey], seen[grey]
        first = torch.from_numpy(feature_from_color(mean_color(seen)))
        feature.index_copy_(0, torch.from_numpy(rows), first.to(feature))


@torch.no_grad()
def hide_unseen(avatar: Avatar) -> None:
    """Make the Gaussians transparent that never had a first colour (release, offline)."""
    avatar.blendshapes.opacity_logit[~avatar.color_initialized] = _HIDDEN_LOGIT


def is_seen_well(sums: _Sums) -> _Sums:
    """Whether the mean colour under each Gaussian can be trusted: [N, 5] -> [N], bool."""
    return (sums[:, 4] > WEIGHT_THRESHOLD) & (sums[:, 3] > _SMALLEST_WEIGHT_SUM)


def mean_color(sums: _Sums) -> _Sums:
    """The mean colour under each Gaussian: [N, 5] -> [N, 3]."""
    return cast(_Sums, sums[:, :3] / sums[:, 3:4].clip(min=_SMALLEST_WEIGHT_SUM))


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
