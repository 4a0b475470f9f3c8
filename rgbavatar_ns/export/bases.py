"""The learned bases, each alone, as the paper's figure of blendshapes shows them."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.drawing.contact_sheet import contact_sheet, labelled
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.drawing import Color, Picture, pictures
from rgbavatar_ns.kernels import PinholeCameras

_CLEAR, _CLEAR_SHARE = 60, 0.01
"""A change is seen where it is so many of 255 steps, in so much of what the avatar covers."""
_STRONGEST_GAIN = 64.0
_CHANGE_GAIN = 2


def single_bases(statistics: TrainingStatistics, gain: float) -> Float[Tensor, "K1 K"]:
    """psi of K + 1 pictures: none, then each basis alone at `gain` times its largest weight seen.

    The largest is the one of largest magnitude, with its sign: what a basis adds when it is
    used most. Scaled, since single bases change little.
    """
    low, high = statistics.psi_min, statistics.psi_max
    extreme = torch.where(high.abs() >= low.abs(), high, low)
    nothing = torch.zeros_like(extreme)[None]
    return torch.cat([nothing, torch.diag(gain * extreme)])


def basis_grid(
    avatar: Avatar,
    statistics: TrainingStatistics,
    camera: PinholeCameras,
    background: Color | None = (1.0, 1.0, 1.0),
    gain: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    columns: int = 4,
) -> Picture:
    """A grid: the base model, then base plus each basis alone and, beside it, what it changes.

    On the head's neutral frame, at `gain` times its largest weight in training; without one, at
    the first of 1, 2, 4 ... 64 that shows it clearly. Changes are shown twice as large, from grey:
    lighter where the basis makes it lighter. Raises UserError where the avatar has no bases.
    """
    count = avatar.config.num_bases
    if count == 0:
        raise UserError("This avatar has no learned bases.", "Train one with num_bases above 0.")
    extreme, theta = single_bases(statistics, 1.0), statistics.theta_neutral[None]

    def drawn(basis: int, times: float) -> Picture:
        return next(pictures(avatar, theta, camera, background, times * extreme[basis : basis + 1]))

    base = drawn(0, 1.0)
    blank = 0 if background is None else 255
    tiles = [np.hstack([labelled(base, "base"), np.full_like(base, blank)])]
    for basis in range(1, count + 1):
        times = 1.0 if gain is None else gain
        picture = drawn(basis, times)
        while gain is None and times < _STRONGEST_GAIN and not _is_clear(picture, base):
            times *= 2
            picture = drawn(basis, times)
        label = f"basis {basis}, x {times:g}: {times * extreme[basis, basis - 1]:+.2f}"
        tiles.append(np.hstack([labelled(picture, label), _change(picture, base)]))
        progress(basis, count)
    return contact_sheet(tiles, columns, blank)


def _is_clear(picture: Picture, base: Picture) -> bool:
    changed = np.abs(picture.astype(int) - base).max(-1)
    covered = (base != base[0, 0]).any(-1).sum()
    return bool((changed >= _CLEAR).sum() >= _CLEAR_SHARE * covered)


def _change(picture: Picture, base: Picture) -> Picture:
    """What was added, about a grey; opaque where there is an alpha."""
    added = _CHANGE_GAIN * (picture.astype(int) - base)
    change = np.clip(128 + added, 0, 255).astype(np.uint8)
    change[..., 3:] = 255
    return change
