"""The learned bases, each alone, as the paper's figure of blendshapes shows them."""

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.drawing.contact_sheet import contact_sheet, labelled
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.drawing import Color, Picture, pictures
from rgbavatar_ns.kernels import PinholeCameras


def basis_weights(statistics: TrainingStatistics, gain: float) -> Float[Tensor, "K1 K"]:
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
    gain: float = 1.5,
    columns: int = 7,
) -> Picture:
    """A grid: the base model, then base plus each basis alone, on the head's neutral frame.

    Raises UserError where the avatar has no bases.
    """
    if avatar.config.num_bases == 0:
        raise UserError("This avatar has no learned bases.", "Train one with num_bases above 0.")
    psi = basis_weights(statistics, gain)
    theta = statistics.theta_neutral.expand(len(psi), -1)
    tiles = list(pictures(avatar, theta, camera, background, psi))
    labels = ["base", *(f"psi {k}: {psi[k + 1, k]:+.2f}" for k in range(len(psi) - 1))]
    written = [labelled(picture, text) for picture, text in zip(tiles, labels)]
    return contact_sheet(written, columns, blank=0 if background is None else 255)
