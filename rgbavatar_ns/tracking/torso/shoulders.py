"""Where a clip's pictures show the shoulders, by mediapipe's pose landmarks."""

import numpy as np
from jaxtyping import Float, UInt8

from rgbavatar_ns.tracking.face.detector import load_mediapipe

_LEFT, _RIGHT = 11, 12
_VISIBLE = 0.6


class ShoulderFinder:
    """mediapipe's pose detector; each picture by itself."""

    def __init__(self) -> None:
        pose = load_mediapipe().solutions.pose
        # The wheel brings the models of complexity 1 alone.
        self._pose = pose.Pose(static_image_mode=True, model_complexity=1)

    def close(self) -> None:
        """Free mediapipe's graph."""
        self._pose.close()

    def __call__(
        self, image_rgb: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[Float[np.ndarray, "2 2"], float] | None:
        """Left and right shoulder as shares of the picture's width and height, and how far the
        chest is turned to the subject's left, in radians; None where they are not seen.

        The shoulders may lie a little outside of the picture.
        """
        found = self._pose.process(np.ascontiguousarray(image_rgb))
        if found.pose_landmarks is None:
            return None
        marks = [found.pose_landmarks.landmark[index] for index in (_LEFT, _RIGHT)]
        if min(mark.visibility for mark in marks) < _VISIBLE:
            return None
        left, right = (found.pose_world_landmarks.landmark[index] for index in (_LEFT, _RIGHT))
        yaw = float(np.arctan2(left.z - right.z, left.x - right.x))
        return np.array([(mark.x, mark.y) for mark in marks]), yaw
