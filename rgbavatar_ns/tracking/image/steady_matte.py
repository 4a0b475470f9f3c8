"""A matte that does not flicker: coarse mattes averaged over time where the image agrees."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

# How many frames before and after are looked at.
NEIGHBOURS = 2
_THUMBNAIL_PX = 128
# Colours (0 to 255) that differ by this much between frames make the other frame count by 1/e.
_AGREE_LEVELS = 8.0
_AGREE_WINDOW_PX = 5


@dataclass(frozen=True)
class CoarseMatte:
    """A frame's coarse matte with a thumbnail of its image, both small and of one size."""

    mask: Float[np.ndarray, "T T"]
    thumbnail: UInt8[np.ndarray, "T T 3"]

    @classmethod
    def of(
        cls, image_rgb: UInt8[np.ndarray, "S S 3"], coarse: Float[np.ndarray, "S S"]
    ) -> "CoarseMatte":
        """Made small: what is averaged needs no more."""
        size = (_THUMBNAIL_PX, _THUMBNAIL_PX)
        return cls(
            cv2.resize(coarse, size, interpolation=cv2.INTER_AREA),
            cv2.resize(image_rgb, size, interpolation=cv2.INTER_AREA),
        )


def steadied(
    coarse: Float[np.ndarray, "S S"],
    now: CoarseMatte,
    near: Sequence[tuple[CoarseMatte, Float[np.ndarray, "2 3"]]],
) -> Float[np.ndarray, "S S"]:
    """This frame's coarse matte, drawn to the mean with its neighbours' where images agree.

    A neighbour counts where its image looks as this one does; elsewhere it is tried once more
    moved along with the head, of whose motion from its crop to this one (pixels of the crop) each
    neighbour comes with. What moves otherwise, and what was hidden, is left alone, so nothing is
    dragged along. As many frames after as before are meant to be given: then there is no lag.
    """
    size, few = len(coarse), len(now.mask)
    total, weights = now.mask.copy(), np.ones_like(now.mask)
    for other, motion in near:
        still = _agreement(other.thumbnail, now.thumbnail)
        # Pixel centres lie at whole numbers for OpenCV and at halves for landmarks.
        linear, shift = motion[:, :2], motion[:, 2] * (few / size)
        small = np.column_stack([linear, shift + linear @ (0.5, 0.5) - 0.5])
        moved = [
            cv2.warpAffine(image, small, (few, few), borderMode=cv2.BORDER_REPLICATE)
            for image in (other.mask, other.thumbnail)
        ]
        along = (1 - still) * _agreement(moved[1], now.thumbnail)
        total += still * other.mask + along * moved[0]
        weights += still + along
    change = cv2.resize(total / weights - now.mask, (size, size))
    return np.clip(coarse + change, 0, 1)


def _agreement(
    a: UInt8[np.ndarray, "T T 3"], b: UInt8[np.ndarray, "T T 3"]
) -> Float[np.ndarray, "T T"]:
    """1 where two images have the same colours, towards 0 where they differ."""
    red, green, blue = cv2.split(cv2.absdiff(a, b))
    differs = cv2.max(cv2.max(red, green), blue).astype(np.float32)
    differs = cv2.blur(differs, (_AGREE_WINDOW_PX, _AGREE_WINDOW_PX)) / _AGREE_LEVELS
    return np.exp(-differs * differs)


def head_motion(
    before_px: Float[np.ndarray, "L 2"], now_px: Float[np.ndarray, "L 2"]
) -> Float[np.ndarray, "2 3"]:
    """The similarity (turn, scale, shift) that brings points nearest to others, least squares."""
    before, now = before_px @ (1, 1j), now_px @ (1, 1j)
    spread = before - before.mean()
    turn = np.vdot(spread, now - now.mean()) / np.vdot(spread, spread).real
    shift = now.mean() - turn * before.mean()
    return np.array(
        [[turn.real, -turn.imag, shift.real], [turn.imag, turn.real, shift.imag]], dtype=np.float64
    )
