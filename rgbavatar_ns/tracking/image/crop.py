"""One square crop that holds head and neck in every frame of a clip."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

# Shares of the face's height (forehead to chin) around the landmarks' box: room for hair above,
# for ears and hair at the sides, for the neck below.
_ABOVE, _SIDES, _BELOW = 0.6, 0.3, 0.35


@dataclass(frozen=True)
class SquareCrop:
    """A square of the source frame (`left`, `top`, `side` in source pixels), resized to `size`.

    It may reach beyond the frame; there the border is repeated and `inside` is False.
    """

    left: int
    top: int
    side: int
    size: int

    @property
    def scale(self) -> float:
        """Output pixels per source pixel."""
        return self.size / self.side

    def apply(
        self, image: UInt8[np.ndarray, "H W *channels"]
    ) -> UInt8[np.ndarray, "size size *channels"]:
        """The square part of the frame (of a picture or a mask) at the output size."""
        height, width = image.shape[:2]
        top, bottom = _within(self.top, self.side, height)
        left, right = _within(self.left, self.side, width)
        part = image[top:bottom, left:right]
        beyond = (top - self.top, self.top + self.side - bottom)
        beside = (left - self.left, self.left + self.side - right)
        if any(beyond + beside):
            part = cv2.copyMakeBorder(part, *beyond, *beside, cv2.BORDER_REPLICATE)
        method = cv2.INTER_AREA if self.size <= self.side else cv2.INTER_CUBIC
        return cv2.resize(part, (self.size, self.size), interpolation=method)

    def inside(self, width: int, height: int) -> Float[np.ndarray, "size size"]:
        """1 where the square shows the frame, 0 where it reaches beyond."""
        rows = np.arange(self.top, self.top + self.side)
        columns = np.arange(self.left, self.left + self.side)
        if rows[0] >= 0 and rows[-1] < height and columns[0] >= 0 and columns[-1] < width:
            return np.ones((self.size, self.size), np.float32)
        within = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
        return cv2.resize(
            within.astype(np.float32), (self.size, self.size), interpolation=cv2.INTER_AREA
        )

    def points(self, points_px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Points of the source frame in pixels of the crop."""
        return (points_px - (self.left, self.top)) * self.scale


def _within(start: int, side: int, span: int) -> tuple[int, int]:
    """The part of start .. start + side that lies in 0 .. span, at least one pixel of it."""
    first = min(max(start, 0), span - 1)
    return first, max(min(start + side, span), first + 1)


def steady_crop(
    landmarks_px: Float[np.ndarray, "F 478 2"], width: int, height: int, size: int
) -> SquareCrop:
    """The smallest square around all frames' landmarks with room for hair, ears and neck.

    It is pushed inside the frame where it fits. One crop for the clip, so that the camera
    stands still and only the head moves.
    """
    face = float(np.median(np.linalg.norm(landmarks_px[:, 10] - landmarks_px[:, 152], axis=-1)))
    low, high = landmarks_px.min((0, 1)), landmarks_px.max((0, 1))
    low = low - face * np.array([_SIDES, _ABOVE])
    high = high + face * np.array([_SIDES, _BELOW])
    side = max(2, int(np.ceil((high - low).max())))
    corner = (low + high) / 2 - side / 2
    left, top = (_push_inside(start, side, span) for start, span in zip(corner, (width, height)))
    return SquareCrop(left, top, side, size)


def _push_inside(start: float, side: int, span: int) -> int:
    if side > span:
        return round((span - side) / 2) if start < 0 and start + side > span else round(start)
    return round(min(max(start, 0), span - side))
