"""The learned bases, each alone, as the paper's figure of blendshapes shows them."""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
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
    return tile([_labelled(picture, text) for picture, text in zip(tiles, labels)], columns)


def tile(tiles: list[np.ndarray], columns: int) -> Picture:
    """Pictures of one size in rows; the last row is filled up with blank ones."""
    columns = min(columns, len(tiles))
    blank = np.full_like(tiles[0], 255 if tiles[0].shape[-1] == 3 else 0)
    filled = tiles + [blank] * (math.ceil(len(tiles) / columns) * columns - len(tiles))
    rows = [filled[start : start + columns] for start in range(0, len(filled), columns)]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows], axis=0)


def _labelled(picture: Picture, text: str) -> Picture:
    """The picture with a small text in its upper left corner."""
    written = np.ascontiguousarray(picture)
    size = picture.shape[0] / 500
    color = (90, 90, 90, 255)[: picture.shape[-1]]
    place = (round(8 * size), round(20 * size) + 4)
    cv2.putText(written, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)
    return written
