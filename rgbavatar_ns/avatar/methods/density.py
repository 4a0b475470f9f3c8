"""Density control of 3D Gaussian splatting: where Gaussians are added, and which are removed.

Source: Kerbl et al. 2023, sec. 5, and its released train.py and scene/gaussian_model.py.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.method import WatchedStep
from rgbavatar_ns.avatar.methods.gaussian_rows import GaussianRows, Optimizers, forget_moments
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.rotations import quat_wxyz_to_matrix
from rgbavatar_ns.options import Between, CheckedOptions, Count, Counted, Positive, Share, Weight

_CHILDREN = 2
_SHRINK = 0.8 * _CHILDREN
"""How much smaller the children of a split are (3DGS)."""


@dataclass(frozen=True)
class DensityControl(CheckedOptions):
    """When and where Gaussians are cloned, split, pruned and made faint; defaults are 3DGS's.

    Steps are numbers of steps taken: `from_step` 500 and `every` 100 change first after 600 steps.
    """

    from_step: Counted = 500
    """Nothing changes until more steps than these are taken."""
    until_step: Counted = 15_000
    """Nothing changes any more once these are taken."""
    every: Count = 100
    """Steps between two changes."""
    gradient_threshold: Positive = 2e-4
    """Mean length, over the images that show a Gaussian, of the gradient of one image's loss by
    its place in the image, whose sides are 2 long, from which it is cloned or split."""
    extent_m: Annotated[float, Between(0.0, 1e6)] = 1.0
    """Size in metres of what is filmed, to which sizes of Gaussians are compared. (3DGS takes the
    spread of the cameras, which for one still camera is 0.)"""
    percent_dense: Share = 0.01
    """Share of the extent up to which a Gaussian's largest scale is small: it is cloned, not
    split."""
    min_opacity: Share = 0.005
    """Gaussians less opaque are removed."""
    largest_scale: Weight = 0.1
    """Share of the extent beyond which a Gaussian's largest scale has it removed; 0 removes
    none."""
    largest_scale_from_step: Counted = 3000
    """Until so many steps are taken none is removed for its size."""
    reset_every: Counted = 3000
    """Steps between two times that all are made faint; 0 for never."""
    reset_opacity: Annotated[float, Between(0, 1, open=True)] = 0.01
    """Opacity that is left to them at most."""
    keep_one_per_face: bool = False
    """Whether Gaussians stay that would be the last of their triangle to be removed
    (GaussianAvatars)."""
    max_count: Count = 1_000_000
    """Most Gaussians; those of the largest gradient are cloned and split first (ours)."""

    def __post_init__(self) -> None:
        """Refuse what would remove everything, and an extent that nothing compares to."""
        super().__post_init__()
        if self.extent_m == 0:
            raise UserError(
                "Density control compares Gaussians with an extent of 0, as the spread of one "
                "still camera is.",
                "Give extent_m, the size in metres of what is filmed; 1 does for a head.",
            )
        if self.reset_every and self.reset_opacity <= self.min_opacity:
            raise UserError(
                f"Gaussians made as faint as {self.reset_opacity:g} would all be removed: "
                f"min_opacity is {self.min_opacity:g}.",
                "Give a reset_opacity above min_opacity, or reset_every 0.",
            )

    def watches(self, step: int) -> bool:
        """Whether the gradients of `step`, counted from 0, still lead to a change."""
        return step + 1 < self.until_step

    def due(self, step: int) -> bool:
        """Whether Gaussians are added and removed after `step`, counted from 0."""
        taken = step + 1
        return self.from_step < taken < self.until_step and taken % self.every == 0

    def resets(self, step: int) -> bool:
        """Whether all are made faint after `step`, counted from 0."""
        taken = step + 1
        return self.watches(step) and self.reset_every > 0 and taken % self.reset_every == 0


class ScreenStatistics(nn.Module):
    """How far each of N Gaussians would be moved in the image, summed since the last change.

    Buffers, so that a resumed run goes on as the uninterrupted one. (3DGS sums up the largest
    radius in the image too, but zeroes it before it is compared: it removes nothing there.)

    Attributes:
        gradient_sum: lengths of the gradients, in units in which an image's sides are 2 long.
        times_seen: images that showed each.
    """

    gradient_sum: Float[Tensor, "N"]
    times_seen: Int[Tensor, "N"]

    def __init__(self, num_gaussians: int) -> None:
        super().__init__()
        self.register_buffer("gradient_sum", torch.zeros(num_gaussians))
        self.register_buffer("times_seen", torch.zeros(num_gaussians, dtype=torch.int64))

    @torch.no_grad()
    def add(
        self,
        gradient_px: Float[Tensor, "B N 2"],
        width: int,
        height: int,
        drawn: Bool[Tensor, "B N"] | None = None,
    ) -> None:
        """Add the gradient of a step's loss, the mean over B images, by the projected means.

        `drawn`: which images count as showing a Gaussian; by default those with a gradient. 3DGS
        counts all in whose picture it lies (`PinholeCameras.shows`), also behind others.
        """
        # By B, because 3DGS's threshold is that of the loss of one image.
        half_width, half_height = (0.5 * side * len(gradient_px) for side in (width, height))
        x, y = gradient_px.unbind(-1)
        length = torch.hypot(half_width * x, half_height * y)
        drawn = length > 0 if drawn is None else drawn
        self.gradient_sum += torch.where(drawn, length, 0.0).sum(0)
        self.times_seen += drawn.sum(0)

    def add_step(self, watched: WatchedStep) -> None:
        """Add a step's gradient; as in 3DGS all count whose centre is in a picture."""
        cameras = watched.cameras
        seen = cameras.shows(watched.gaussians.means.detach())
        self.add(watched.screen_gradient_px, cameras.width, cameras.height, seen)

    def mean_gradient(self) -> Float[Tensor, "N"]:
        """Mean length of the gradient over the images that showed each; 0 for what none did."""
        return self.gradient_sum / self.times_seen.clamp(min=1)

    def begin(self, num_gaussians: int) -> None:
        """Forget everything, for as many Gaussians."""
        self.gradient_sum = self.gradient_sum.new_zeros(num_gaussians)
        self.times_seen = self.times_seen.new_zeros(num_gaussians)


SplitRule = Callable[[Int[Tensor, "M"], Float[Tensor, "M S 3"]], Mapping[str, Tensor]]
"""From the rows that are split and S standard normal samples for each to what its S children do
not copy: by the tensor's name [M, S, ...], with their place at least."""


def sampled_positions(
    position: Float[Tensor, "M 3"],
    rotation_wxyz: Float[Tensor, "M 4"],
    scale: Float[Tensor, "M 3"],
    samples: Float[Tensor, "M S 3"],
) -> Float[Tensor, "M S 3"]:
    """Places drawn from Gaussians, in the frame and unit of their positions and scales."""
    turned = (samples * scale[:, None]) @ quat_wxyz_to_matrix(rotation_wxyz).mT
    return position[:, None] + turned


@dataclass(frozen=True)
class ControlledGaussians:
    """What density control knows of a method's Gaussians.

    `world_scale_m` gives their standard deviations in metres as they are now, `split` the places
    of the children of those that are split. `log_scale`, `opacity_logit` and `face_of` name
    tensors among the rows: the logarithm of scales in any unit [N, 3], of opacities [N] or [N, 1],
    and of the triangles that carry them [N].
    """

    rows: GaussianRows
    statistics: ScreenStatistics
    world_scale_m: Callable[[], Float[Tensor, "N 3"]]
    split: SplitRule
    log_scale: str = "log_scale"
    opacity_logit: str = "opacity_logit"
    face_of: str | None = None


@dataclass(frozen=True)
class DensityChanges:
    """What a change did: how many Gaussians were cloned, split in two and removed, and are there.

    `kept_for_faces` would have been removed, if their triangle had another one.
    """

    cloned: int = 0
    split: int = 0
    pruned: int = 0
    kept_for_faces: int = 0
    opacity_reset: bool = False
    count: int = field(kw_only=True)

    def figures(self) -> dict[str, float]:
        """Each by its name, as `AvatarMethod.after_step` tells of them."""
        return {name: float(value) for name, value in vars(self).items()}


@torch.no_grad()
def control(
    gaussians: ControlledGaussians,
    options: DensityControl,
    optimizers: Optimizers,
    *,
    step: int,
    seed: int,
) -> DensityChanges | None:
    """Clone, split, prune and make faint what is due after a step; None where nothing is.

    Those of large gradient are cloned where small, and else replaced by two samples of them 1.6
    times smaller. Copies keep all that their original has, but Adam's moments, which are 0.
    `step`, counted from 0, and `seed` alone decide the samples. UserError where no Gaussian would
    remain.
    """
    optimizers = list(optimizers)
    due, resets = options.due(step), options.resets(step)
    if not due and not resets:
        return None
    cloned = split = pruned = kept = 0
    if due:
        cloned, split = _densify(gaussians, options, optimizers, step, seed)
        pruned, kept = _prune(gaussians, options, optimizers, step)
        gaussians.statistics.begin(gaussians.rows.count)
    if resets:
        _make_faint(gaussians, options.reset_opacity, optimizers)
    return DensityChanges(cloned, split, pruned, kept, resets, count=gaussians.rows.count)


def _densify(
    gaussians: ControlledGaussians,
    options: DensityControl,
    optimizers: Optimizers,
    step: int,
    seed: int,
) -> tuple[int, int]:
    """How many were cloned and split."""
    rows, gradient = gaussians.rows, gaussians.statistics.mean_gradient()
    wanted = gradient >= options.gradient_threshold
    # A clone adds one, a split too: two for one.
    room = max(0, options.max_count - rows.count)
    if int(wanted.sum()) > room:
        first = torch.argsort(gradient, descending=True, stable=True)[:room]
        wanted = wanted & torch.zeros_like(wanted).index_fill(0, first, True)
    large = gaussians.world_scale_m().amax(-1) > options.percent_dense * options.extent_m
    to_split, to_clone = (wanted & large).nonzero()[:, 0], (wanted & ~large).nonzero()[:, 0]
    if len(to_split) + len(to_clone) == 0:
        return 0, 0
    log_scale = rows[gaussians.log_scale]
    samples = torch.from_numpy(_random(seed, step).standard_normal((len(to_split), _CHILDREN, 3)))
    children = gaussians.split(to_split, samples.to(log_scale))
    staying = (~(wanted & large)).nonzero()[:, 0]
    source = torch.cat([staying, to_clone, to_split.repeat_interleave(_CHILDREN)])
    fresh = torch.arange(len(source), device=source.device) >= len(staying)
    rows.take(source, optimizers, fresh)
    first_child = len(staying) + len(to_clone)
    rows[gaussians.log_scale][first_child:] -= math.log(_SHRINK)
    for name, values in children.items():
        rows[name][first_child:] = values.flatten(0, 1)
    return len(to_clone), len(to_split)


def _prune(
    gaussians: ControlledGaussians, options: DensityControl, optimizers: Optimizers, step: int
) -> tuple[int, int]:
    """How many were removed, and how many of those to be removed stay for their triangles."""
    rows = gaussians.rows
    opacity = torch.sigmoid(rows[gaussians.opacity_logit]).reshape(rows.count)
    doomed = opacity < options.min_opacity
    if options.largest_scale and step + 1 > options.largest_scale_from_step:
        largest_m = options.largest_scale * options.extent_m
        doomed = doomed | (gaussians.world_scale_m().amax(-1) > largest_m)
    kept = 0
    if options.keep_one_per_face:
        if gaussians.face_of is None:
            raise ValueError("No face_of names the triangles that shall keep their Gaussians.")
        spared = doomed & ~_face_goes_on(rows[gaussians.face_of], ~doomed)
        doomed, kept = doomed & ~spared, int(spared.sum())
    if bool(doomed.all()):
        raise UserError(
            f"Density control would leave nothing: each of {rows.count} Gaussians is less opaque "
            f"than {options.min_opacity:g} or too large.",
            "Lower the bound of opacity, raise that of size, or reset opacities less often.",
        )
    if bool(doomed.any()):
        rows.take((~doomed).nonzero()[:, 0], optimizers)
    return int(doomed.sum()), kept


def _face_goes_on(face_of: Int[Tensor, "N"], stays: Bool[Tensor, "N"]) -> Bool[Tensor, "N"]:
    """Whether the triangle of each Gaussian has one that stays."""
    remaining = torch.bincount(face_of[stays], minlength=int(face_of.max()) + 1)
    return remaining[face_of] > 0


def _make_faint(gaussians: ControlledGaussians, opacity: float, optimizers: Optimizers) -> None:
    """Bound all opacities from above, and have Adam forget where they were going."""
    logit = gaussians.rows[gaussians.opacity_logit]
    logit.clamp_(max=math.log(opacity / (1 - opacity)))
    if isinstance(logit, nn.Parameter):
        forget_moments(logit, optimizers)


@torch.no_grad()
def prune_and_refill(
    rows: GaussianRows,
    keep: Bool[Tensor, "N"],
    count: int,
    optimizers: Optimizers,
    *,
    position: str = "position",
    jitter_m: float,
    step: int,
    seed: int,
    remedy: str,
) -> DensityChanges:
    """Remove what is not kept, then copy what remains, moved at random, up to `count` Gaussians.

    Copies lie in a cube with sides of `jitter_m` (in the unit of `position`) around what they
    copy, which is drawn with replacement; their moments are 0. UserError where nothing is kept,
    with the caller's `remedy`.
    Source: MonoGaussianAvatar, code/scripts/train.py, model/point_cloud.py (there the whole
    optimiser begins anew).
    """
    if not bool(keep.any()):
        raise UserError(
            f"Density control would leave nothing: each of {len(keep)} Gaussians is so "
            "transparent that it is removed.",
            remedy,
        )
    staying = keep.nonzero()[:, 0]
    missing, random = max(0, count - len(staying)), _random(seed, step)
    drawn = torch.from_numpy(random.integers(len(staying), size=missing)).to(staying)
    moved = torch.from_numpy(random.random((missing, 3)) - 0.5) * jitter_m
    pruned = rows.count - len(staying)
    if missing or pruned:
        source = torch.cat([staying, staying[drawn]])
        fresh = torch.arange(len(source), device=source.device) >= len(staying)
        rows.take(source, optimizers, fresh)
        rows[position][len(staying) :] += moved.to(rows[position])
    return DensityChanges(cloned=missing, pruned=pruned, count=rows.count)


def _random(seed: int, step: int) -> np.random.Generator:
    """A pure function of both; another stream than that of the step's backgrounds."""
    key = np.array([seed, step], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, 1]))
