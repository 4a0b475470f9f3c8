"""A mesh as a camera sees it: where its vertices are in the picture, and what it covers."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from rgbavatar_ns.kernels import PinholeCameras


@dataclass(frozen=True)
class PlacedMesh:
    """The mesh as one camera sees it, in its own axes."""

    places_m: Float[Tensor, "V 3"]
    normals: Float[Tensor, "V 3"]
    focal_px: Float[Tensor, "2"]
    principal_point_px: Float[Tensor, "2"]

    @classmethod
    def of(cls, vertices: Tensor, normals: Tensor, cameras: PinholeCameras, k: int) -> "PlacedMesh":
        """Frame k of a batch with one camera, or one a frame."""
        camera = cameras.select([k % len(cameras.focal_px)])
        pose = camera.world_to_camera[0].cpu().to(vertices)
        return cls(
            vertices[k] @ pose[:3, :3].T + pose[:3, 3],
            normals[k] @ pose[:3, :3].T,
            camera.focal_px[0].cpu().to(vertices),
            camera.principal_point_px[0].cpu().to(vertices),
        )

    @property
    def px_of_metre(self) -> float:
        """How large a metre is in the picture, at the vertices' mean distance."""
        return float(self.focal_px[0] / self.places_m[:, 2].mean())

    def is_upright(self, height_m: Float[Tensor, "V"]) -> bool:
        """Whether a mesh of these heights stands in the picture, within 45 degrees."""
        across, down, _ = self.places_m[height_m.argmin()] - self.places_m[height_m.argmax()]
        return bool(down > across.abs())

    def moved(self, offset_m: Float[Tensor, "V"] | float) -> Float[np.ndarray, "V 2"]:
        """Where the vertices, moved along their normals, are in the picture."""
        offset = torch.as_tensor(offset_m, dtype=self.places_m.dtype).reshape(-1, 1)
        moved = self.places_m + offset * self.normals
        px = moved[:, :2] / moved[:, 2:].clamp(min=1e-3) * self.focal_px + self.principal_point_px
        return px.numpy().astype(np.float32)


def covered_pixels(
    px: Float[np.ndarray, "V 2"],
    faces: Int[np.ndarray, "F 3"],
    width: int,
    height: int,
    values: Bool[np.ndarray, "F"] | None = None,
) -> UInt8[np.ndarray, "height width"]:
    """1 where a projected mesh covers or touches a pixel, or each face's value, the last one's."""
    mesh = np.zeros((height, width), np.uint8)
    values = np.ones(len(faces), bool) if values is None else values
    # OpenCV's first pixel has its centre at 0.
    corners = np.round((px[faces].clip(-(2**14), 2**14) - 0.5) * 16).astype(np.int32)
    for triangle, value in zip(corners, values.tolist()):
        cv2.fillConvexPoly(mesh, triangle, (int(value),), shift=4)
    return mesh
