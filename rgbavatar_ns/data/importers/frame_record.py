"""The one internal record of all formats: what a format says of one image."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.data.importers.frame_images import FrameImage
from rgbavatar_ns.data.importers.import_report import UnusableFrameError

_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class CameraRecord:
    """One camera: OpenCV axes (x right, y down, z forward), metres, pixels."""

    world_to_camera: Float[np.ndarray, "4 4"]
    focal_px: Float[np.ndarray, "2"]
    principal_point_px: Float[np.ndarray, "2"]

    def __post_init__(self) -> None:
        rotation = self.world_to_camera[:3, :3]
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not off < _ROTATION_TOLERANCE or np.linalg.det(rotation) <= 0:
            raise UnusableFrameError("cameras whose matrix is no rotation and shift")
        if not (self.focal_px > 0).all():
            raise UnusableFrameError("cameras whose focal length is not positive")


@dataclass(frozen=True)
class FrameRecord:
    """What a format says of one image; the pixels stay in their files.

    theta: head parameters by field of the head model's layout; a missing one is zero.
    size: (width, height) that the camera is meant for, where the format says it.
    """

    index: int
    frame_image: FrameImage
    theta: Mapping[str, Float[np.ndarray, "_"]]
    camera: CameraRecord
    size: tuple[int, int] | None = None
    camera_name: str | None = None
    timestep: int | None = None
