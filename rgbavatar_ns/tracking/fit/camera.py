"""The still camera of a clip: the head near the world's origin, the camera in front of it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.errors import UserError

_SHORTEST, _LONGEST = 0.25, 50.0
"""Focal lengths of cameras, in longer sides of the picture: 127 degrees wide, and 1.1."""
_FULL_FRAME_MM = 36


def require_possible_focal(focal_px: float | None, width: int, height: int) -> None:
    """UserError for a focal length that no camera of such pictures has; None is an unknown one."""
    side = max(width, height)
    low, high = _SHORTEST * side, _LONGEST * side
    if focal_px is not None and not low <= focal_px <= high:
        raise UserError(
            f"A focal length of {focal_px:g} pixels is no camera's whose pictures have "
            f"{width} x {height}: those are from {low:.0f} to {high:.0f} pixels.",
            f"Leave --focal-px out, which suits most films, or give pixels of the film: "
            f"millimetres of a 35 mm camera times {side / _FULL_FRAME_MM:.3g}.",
        )


@dataclass(frozen=True)
class StillCamera:
    """OpenCV pinhole on the world's z axis at `distance_m`, looking back at the origin.

    World: y up, z towards the camera (head convention). Image coordinates in pixels.
    """

    focal_px: float
    center_px: tuple[float, float]
    distance_m: float

    @property
    def world_to_camera(self) -> Float[np.ndarray, "4 4"]:
        """OpenCV camera coordinates (x right, y down, z forward) from world coordinates."""
        matrix = np.diag([1.0, -1.0, -1.0, 1.0])
        matrix[2, 3] = self.distance_m
        return matrix

    @property
    def eye_m(self) -> Float[np.ndarray, "3"]:
        """Where the camera is, in the world."""
        return np.array([0.0, 0.0, self.distance_m])

    def scaled(self, scale: float) -> "StillCamera":
        """The camera of smaller pictures, whose first centre is at 0, as OpenCV has it."""
        x, y = self.center_px
        center = (x * scale - 0.5, y * scale - 0.5)
        return replace(self, focal_px=self.focal_px * scale, center_px=center)

    def project(self, points_m: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Image points in pixels."""
        depth = self.distance_m - points_m[..., 2]
        across = points_m[..., :2] * (1.0, -1.0)
        return self.focal_px * across / depth[..., None] + self.center_px

    def px_per_m(self, z_m: float) -> float:
        """How many pixels a metre across the picture is, `z_m` before the world's origin."""
        return float(self.focal_px / (self.distance_m - z_m))

    def image_slope(self, points_m: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 2 3"]:
        """Derivative of `project` to the points, pixels a metre."""
        depth = self.distance_m - points_m[:, 2]
        across = self.focal_px / depth
        slope = np.zeros((len(points_m), 2, 3))
        slope[:, 0, 0], slope[:, 1, 1] = across, -across
        slope[:, :, 2] = (across / depth)[:, None] * points_m[:, :2] * (1.0, -1.0)
        return slope
