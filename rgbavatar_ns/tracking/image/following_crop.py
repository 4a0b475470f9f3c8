"""A square crop for a stream: it stands still until the head is about to leave it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.tracking.image.crop import SquareCrop, steady_crop

# How much larger than the head's own square the crop is: the head may move that much within.
_ROOM = 1.25


@dataclass
class FollowingCrop:
    """`square` holds the head with room around; `follow` moves it, as little as that needs.

    Its side stays, so that a moved square is the same camera with another principal point.
    """

    square: SquareCrop
    width: int
    height: int

    @classmethod
    def around(
        cls, landmarks_px: Float[np.ndarray, "F 478 2"], width: int, height: int, size: int
    ) -> "FollowingCrop":
        """A crop with room around the head of these frames, images of `size` pixels."""
        tight = steady_crop(landmarks_px, width, height, size)
        side = round(tight.side * _ROOM)
        grown = (side - tight.side) // 2
        left = _inside(tight.left - grown, side, width)
        top = _inside(tight.top - grown, side, height)
        return cls(SquareCrop(left, top, side, size), width, height)

    def follow(self, landmarks_px: Float[np.ndarray, "478 2"]) -> None:
        """Move the square if the head of this frame, with hair and neck, is not within it."""
        head = steady_crop(landmarks_px[None], self.width, self.height, self.square.size)
        left = _moved(self.square.left, self.square.side, head.left, head.side)
        top = _moved(self.square.top, self.square.side, head.top, head.side)
        if (left, top) != (self.square.left, self.square.top):
            self.square = replace(self.square, left=left, top=top)


def _moved(start: int, side: int, head_start: int, head_side: int) -> int:
    """The start of a span of `side` that holds the head's, near the present one.

    When it must move it moves to where the head is in its middle, so that it soon stands again.
    """
    if start <= head_start and head_start + head_side <= start + side:
        return start
    return head_start + (head_side - side) // 2


def _inside(start: int, side: int, span: int) -> int:
    return min(max(start, 0), max(span - side, 0)) if side <= span else start
