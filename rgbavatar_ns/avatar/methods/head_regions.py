"""Parts of the head's mesh, and where they are in pictures, for losses that weigh them."""

from collections.abc import Iterable

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rgbavatar_ns.drawing.wireframe import fixed_point
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.arrays import TEETH, TONGUE
from rgbavatar_ns.kernels import PinholeCameras

MOUTH_GROUPS = (*TEETH, TONGUE)
"""Vertex groups of what is behind the lips."""


def group_vertices(arrays: HeadArrays, names: Iterable[str]) -> Int[Tensor, "G"]:
    """The vertices of those groups that this head has; of a head without any, none."""
    return torch.from_numpy(arrays.vertices_of(names))


def faces_within(arrays: HeadArrays, faces: Int[Tensor, "F 3"], name: str) -> Bool[Tensor, "F"]:
    """Triangles with all corners in this group; of a head without it, none."""
    return torch.isin(faces, group_vertices(arrays, [name]).to(faces)).all(1)


@torch.no_grad()
def hull_mask(points: Float[Tensor, "B G 3"], cameras: PinholeCameras) -> Bool[Tensor, "B H W"]:
    """Pixels within or touching the convex hull of points in the picture; none without points.

    With the vertices of `MOUTH_GROUPS` it is the mouth, open or closed, as far as teeth reach: ours
    in place of FlashAvatar's face parsing.
    """
    masks = np.zeros((len(points), cameras.height, cameras.width), np.uint8)
    for mask, px in zip(masks, cameras.project(points).float().cpu().numpy()):
        if len(px):
            # Within 16 bits, so that OpenCV's fixed point does not overflow.
            hull = cv2.convexHull(px.clip(-(2**14), 2**14))
            cv2.fillConvexPoly(mask, fixed_point(hull), (1,), shift=4)
    return torch.from_numpy(masks > 0).to(points.device)
