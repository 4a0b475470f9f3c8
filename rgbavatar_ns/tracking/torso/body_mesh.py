"""The fitted person's body as it stands before the camera: which pixels show it, and how deep."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.joints import NECK, ROOT
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion

_AROUND_HEAD_M = 0.025
# A body is drawn so large to find what of it is seen, and where its depth leaps by so much within
# so many pixels it hides a part of itself: points there are an outline's, which slides.
_RASTER_PX, _AROUND_PX, _EDGE_M = 480, 9, 0.03


@dataclass(frozen=True)
class BodyMesh:
    """The part of one person's mesh that the root joint carries, at rest, in metres."""

    vertices_m: Float[np.ndarray, "B 3"]
    faces: Int[np.ndarray, "F 3"]
    neck_m: Float[np.ndarray, "3"]
    """The neck's joint, about which the head turns upon the body."""
    shoulders_m: Float[np.ndarray, "2 3"]
    """Where both shoulders' joints lie, the left one first."""
    head_faces: Int[np.ndarray, "T 3"]

    @classmethod
    def of(cls, head: HeadModel, identity: Float[np.ndarray, "I"]) -> "BodyMesh":
        """The body of a head model with a torso."""
        arrays = head.arrays
        person = torch.from_numpy(identity).to(head.uv.dtype)
        with torch.no_grad():
            theta = torch.zeros(head.layout.size, dtype=person.dtype)
            rest = head(theta, person).double().numpy()
            joints = head.joints(person).double().numpy()
        with_body = arrays.skinning_weights[:, ROOT] > 0.5
        used, faces = np.unique(arrays.faces[with_body[arrays.faces].all(1)], return_inverse=True)
        return cls(
            rest[used],
            faces.reshape(-1, 3),
            joints[NECK],
            _shoulders(rest[arrays.vertex_groups["torso"]]),
            arrays.faces[~with_body[arrays.faces].any(1)].astype(np.int64),
        )

    def lifted(
        self, points_px: Float[np.ndarray, "P 2"], placed: RigidMotion, camera: StillCamera
    ) -> tuple[Float[np.ndarray, "P 3"], Bool[np.ndarray, "P"]]:
        """Places on the body that are seen at pixels, in the world.

        The second tells which lie on it, and not where it hides a part of itself.
        """
        world = placed(self.vertices_m)
        scale = 0.5 * _RASTER_PX / max(camera.center_px)
        width, height = (int(2 * scale * c) + 2 for c in camera.center_px)
        # From far to near: what is drawn last is seen.
        corners_m = world[self.faces]
        order = np.argsort(corners_m[..., 2].mean(1))
        corners = np.round(scale * camera.project(corners_m).clip(-(2**14), 2**14) * 8)
        seen = np.full((height, width), -1, np.float32)
        for triangle in order:
            cv2.fillConvexPoly(
                seen, corners[triangle].astype(np.int32), (float(triangle),), shift=3
            )
        column, row = np.floor(scale * points_px).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        column, row = column.clip(0, width - 1), row.clip(0, height - 1)
        triangle = np.where(inside, seen[row, column], -1).astype(int)
        depth = np.where(seen < 0, np.nan, corners_m[..., 2].mean(1)[seen.astype(int)])
        depth = np.where(np.isnan(depth), -_EDGE_M * 1e3, depth).astype(np.float32)
        around = np.ones((_AROUND_PX, _AROUND_PX), np.uint8)
        smooth = cv2.dilate(depth, around) - cv2.erode(depth, around) < _EDGE_M
        first, second, third = corners_m[triangle].transpose(1, 0, 2)
        normal = np.cross(second - first, third - first)
        x, y = ((points_px - camera.center_px) / camera.focal_px).T
        ray = np.stack([x, -y, -np.ones_like(x)], axis=1)
        along = (normal * ray).sum(1)
        along = np.where(np.abs(along) < 1e-12, 1.0, along)
        reach = (normal * (first - camera.eye_m)).sum(1) / along
        return camera.eye_m + reach[:, None] * ray, (triangle >= 0) & smooth[row, column]

    def head_px(
        self, vertices_px: Float[np.ndarray, "V 2"], width: int, height: int, px_per_m: float
    ) -> Bool[np.ndarray, "height width"]:
        """Where the head may be, hair and collar with it; `px_per_m` at its depth."""
        mask = np.zeros((height, width), np.uint8)
        corners = np.round(vertices_px[self.head_faces].clip(-(2**14), 2**14) * 8).astype(np.int32)
        for triangle in corners:
            cv2.fillConvexPoly(mask, triangle, (1,), shift=3)
        reach = 2 * round(_AROUND_HEAD_M * px_per_m) + 1
        return cv2.dilate(mask, np.ones((reach, reach), np.uint8)) > 0


def _shoulders(torso_m: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "2 3"]:
    """Places of both shoulders, as pose detectors mark them, on a torso at rest whose arms hang."""
    found = []
    for side in (1, -1):
        x = side * torso_m[:, 0]
        arm = torso_m[x > 0.72 * x.max()]
        top = arm[:, 1].max()
        near = arm[arm[:, 1] > top - 0.06]
        found.append(near.mean(0))
    return np.array(found)
