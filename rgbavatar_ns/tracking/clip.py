"""The landmarks of a whole clip, and which frames have none."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.landmarks import FaceLandmarker
from rgbavatar_ns.tracking.video import FrameSource


@dataclass(frozen=True)
class ClipLandmarks:
    """Landmarks (source pixels) of the frames that show a face, and which frames those are.

    `frame_index` counts all frames read, `clip` says from which file each one is.
    """

    points_px: Float[np.ndarray, "F 478 2"]
    frame_index: tuple[int, ...]
    clip: tuple[int, ...]
    frames_read: int
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.frame_index)

    def follows(self) -> list[bool]:
        """Whether each frame comes directly after the one before it in the same clip."""
        steps = zip(self.frame_index, self.frame_index[1:], self.clip, self.clip[1:])
        return [False] + [b == a + 1 and c == d for a, b, c, d in steps]

    def without(self, positions: Collection[int]) -> "ClipLandmarks":
        """The same without the frames at these positions."""
        keep = [k for k in range(len(self)) if k not in positions]
        return ClipLandmarks(
            self.points_px[keep],
            tuple(self.frame_index[k] for k in keep),
            tuple(self.clip[k] for k in keep),
            self.frames_read,
            self.width,
            self.height,
        )


def find_landmarks(source: FrameSource, advance: Callable[[], None]) -> ClipLandmarks:
    """Landmarks of every frame that shows a face, in one pass; UserError if none does."""
    points: list[Float[np.ndarray, "478 2"]] = []
    index: list[int] = []
    clip: list[int] = []
    frames_read, width, height = 0, 0, 0
    with FaceLandmarker() as landmarker:
        for frame in source:
            frames_read += 1
            height, width = frame.image_rgb.shape[:2]
            found = landmarker(frame.image_rgb)
            if found is not None:
                points.append(found)
                index.append(frame.index)
                clip.append(frame.clip)
            advance()
    if not points:
        raise UserError(
            f"No face was found in any of the {frames_read} frames.",
            "Use a video in which a face is seen from the front, in good light, and at least "
            "60 pixels high.",
        )
    return ClipLandmarks(np.array(points), tuple(index), tuple(clip), frames_read, width, height)
