"""Square crops that hold head and neck: one for a whole clip, or one that follows a stream."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8

from rgbavatar_ns.kernels.types import PinholeCameras
from rgbavatar_ns.tracking.face.detector import face_height_px
from rgbavatar_ns.tracking.fit.camera import StillCamera

# Shares of the face's height (forehead to chin) around the landmarks' box: room for hair above,
# for ears and hair at the sides, for the neck below.
_ABOVE, _SIDES, _BELOW = 0.6, 0.3, 0.35
# The same for whoever shall have shoulders: beside the face, and below the chin down to the chest.
_BODY_SIDES, _BODY_BELOW = 0.95, 1.3
# How much larger than the head's own square a following crop is: so much may the head move.
_ROOM = 1.25
# Of alpha: below it a pixel has no colour of its own.
_HARDLY = 0.5 / 255
_HEAD_PX, _MOST_PX, _MULTIPLE_PX = 256, 512, 16
SHARP_PX = 400
"""From so many pixels on a film shows more than images of a head of 256 pixels hold; one of fewer
is better made smaller, which takes its noise out."""


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
        """The square part of the frame (of an image or a mask) at the output size."""
        return self._resized(self._part(image))

    def matted(
        self, image_rgb: UInt8[np.ndarray, "H W 3"], alpha: UInt8[np.ndarray, "H W"]
    ) -> tuple[UInt8[np.ndarray, "size size 3"], Float[np.ndarray, "size size"]]:
        """The same of an image with straight alpha, which is in [0, 1] afterwards.

        A pixel's colour counts as far as it is opaque, so that what is hidden stays so.
        """
        color, weight = self._part(image_rgb), self._part(alpha).astype(np.float32)[..., None] / 255
        mean = self._resized(np.concatenate([color * weight, weight], -1))
        level = mean[..., 3]
        shown = level > _HARDLY
        own = mean[..., :3] / np.where(shown, level, 1)[..., None]
        straight = np.where(shown[..., None], own.round().clip(0, 255), self._resized(color))
        return straight.astype(np.uint8), level.clip(0, 1)

    def _part(
        self, image: UInt8[np.ndarray, "H W *channels"]
    ) -> UInt8[np.ndarray, "S S *channels"]:
        height, width = image.shape[:2]
        top, bottom = _within(self.top, self.side, height)
        left, right = _within(self.left, self.side, width)
        part = image[top:bottom, left:right]
        beyond = (top - self.top, self.top + self.side - bottom)
        beside = (left - self.left, self.left + self.side - right)
        if any(beyond + beside):
            part = cv2.copyMakeBorder(part, *beyond, *beside, cv2.BORDER_REPLICATE)
        return part

    def _resized(self, part: Shaped[np.ndarray, "S S *channels"]) -> Any:
        method = cv2.INTER_AREA if self.size <= self.side else cv2.INTER_CUBIC
        return cv2.resize(part, (self.size, self.size), interpolation=method)

    def inside(self, width: int, height: int) -> Bool[np.ndarray, "size size"]:
        """Where a pixel shows nothing but the frame; elsewhere the square reaches beyond."""
        rows = np.arange(self.top, self.top + self.side)
        columns = np.arange(self.left, self.left + self.side)
        if rows[0] >= 0 and rows[-1] < height and columns[0] >= 0 and columns[-1] < width:
            return np.ones((self.size, self.size), bool)
        within = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
        beyond = cv2.resize(
            (~within).astype(np.float32), (self.size, self.size), interpolation=cv2.INTER_AREA
        )
        return beyond == 0

    def points(self, points_px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Points of the source frame in pixels of the crop."""
        return (points_px - (self.left, self.top)) * self.scale

    def pinhole(self, camera: StillCamera) -> PinholeCameras:
        """The source frame's camera, as the rasterizer takes it, for the crop."""
        focal_px = camera.focal_px * self.scale
        return PinholeCameras(
            torch.from_numpy(camera.world_to_camera).float()[None],
            torch.tensor([[focal_px, focal_px]], dtype=torch.float32),
            torch.tensor([self.points(np.array(camera.center_px)).tolist()], dtype=torch.float32),
            self.size,
            self.size,
        )


def _within(start: int, side: int, span: int) -> tuple[int, int]:
    """The part of start .. start + side that lies in 0 .. span, at least one pixel of it."""
    first = min(max(start, 0), span - 1)
    return first, max(min(start + side, span), first + 1)


def steady_crop(
    landmarks_px: Float[np.ndarray, "F 478 2"],
    width: int,
    height: int,
    size: int | None,
    *,
    with_body: bool = False,
) -> SquareCrop:
    """The smallest square around all frames' landmarks with room for hair, ears and neck.

    With the body there is room for shoulders and chest too, as far as the frame shows them. It is
    pushed inside the frame where it fits. One crop for the clip, so that the camera stands still
    and only the person moves. A size of None keeps the film's own pixels, up to 512, where
    there are `SHARP_PX`, and else gives the head's own square 256.
    """
    head = _head_square(landmarks_px, width, height)
    square = _body_square(landmarks_px, head, width, height) if with_body else head
    if size is None:
        size = round(_HEAD_PX * square.side / head.side / _MULTIPLE_PX) * _MULTIPLE_PX
        if square.side >= SHARP_PX:
            size = max(size, min(_MOST_PX, square.side // _MULTIPLE_PX * _MULTIPLE_PX))
    return replace(square, size=size)


def _body_square(
    landmarks_px: Float[np.ndarray, "F 478 2"], head: SquareCrop, width: int, height: int
) -> SquareCrop:
    """The head's square grown downwards and to both sides, as far as the frame goes."""
    face = float(np.median(face_height_px(landmarks_px)))
    low, high = landmarks_px.min((0, 1)), landmarks_px.max((0, 1))
    across = high[0] - low[0] + 2 * _BODY_SIDES * face
    down = high[1] + _BODY_BELOW * face - head.top
    side = min(max(int(np.ceil(max(across, down))), head.side), max(head.side, min(width, height)))
    left = _push_inside((low[0] + high[0] - side) / 2, side, width)
    return SquareCrop(left, _push_inside(float(head.top), side, height), side, head.size)


def _head_square(landmarks_px: Float[np.ndarray, "F 478 2"], width: int, height: int) -> SquareCrop:
    face = float(np.median(face_height_px(landmarks_px)))
    low, high = landmarks_px.min((0, 1)), landmarks_px.max((0, 1))
    low = low - face * np.array([_SIDES, _ABOVE])
    high = high + face * np.array([_SIDES, _BELOW])
    side = max(2, int(np.ceil((high - low).max())))
    corner = (low + high) / 2 - side / 2
    left, top = (_push_inside(start, side, span) for start, span in zip(corner, (width, height)))
    return SquareCrop(left, top, side, _HEAD_PX)


def _push_inside(start: float, side: int, span: int) -> int:
    if side > span:
        return round((span - side) / 2) if start < 0 and start + side > span else round(start)
    return round(min(max(start, 0), span - side))


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
