"""Which part of the picture the head mesh can explain: the matte fades out below its neck."""

import cv2
import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.drawing.wireframe import mesh_silhouette

# Shares of the face's height (forehead to chin): how far hair may stand off the skull, how far
# skin may lie beside the fitted mesh, over what length the neck fades out, and how far below the
# chin nothing is cut.
_HAIR, _MARGIN, _FADE, _BELOW_CHIN = 0.4, 0.05, 0.12, 0.08
REGION_PX = 128
"""Size at which the region is made: all its edges are soft."""


def neck_ring(faces: Int[np.ndarray, "T 3"]) -> Int[np.ndarray, "R"]:
    """Vertices of the longest open border of the mesh: where the neck was cut off."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    neighbours: dict[int, list[int]] = {}
    for a, b in unique[counts == 1].tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    longest: set[int] = set()
    while neighbours:
        loop, pending = set(), [next(iter(neighbours))]
        while pending:
            vertex = pending.pop()
            if vertex in neighbours:
                loop.add(vertex)
                pending += neighbours.pop(vertex)
        longest = max(longest, loop, key=len)
    return np.array(sorted(longest), dtype=np.int64)


class HeadMask:
    """Soft mask of the part of the picture that the head (and not the shoulders) explains.

    The head is the part of the mesh that follows the neck joint more than the root. Above the
    chin its silhouette grows by the hair's margin; below it only by a little, and it fades out
    towards the ring at which this part ends.
    """

    def __init__(
        self, faces: Int[np.ndarray, "T 3"], skinning_weights: Float[np.ndarray, "V 5"]
    ) -> None:
        with_head = skinning_weights[:, 0] < 0.5
        self._faces = faces[with_head[faces].all(1)]
        self._ring = neck_ring(self._faces)

    def __call__(
        self,
        vertices_px: Float[np.ndarray, "V 2"],
        forehead_px: Float[np.ndarray, "2"],
        chin_px: Float[np.ndarray, "2"],
        size: int,
    ) -> Float[np.ndarray, "size size"]:
        """1 on head and neck, 0 below, for a square image of `size` pixels.

        Made at `REGION_PX` at most, then enlarged.
        """
        few = min(size, REGION_PX)
        shrink = few / size
        region = self.of_silhouette(
            self.silhouette(vertices_px * shrink, few),
            vertices_px * shrink,
            forehead_px * shrink,
            chin_px * shrink,
        )
        return cv2.resize(region, (size, size)) if few < size else region

    def silhouette(
        self, vertices_px: Float[np.ndarray, "V 2"], size: int
    ) -> Float[np.ndarray, "size size"]:
        """Where the head and its neck are, without shoulders: 1, elsewhere 0."""
        return mesh_silhouette(vertices_px, self._faces, size)

    def of_silhouette(
        self,
        silhouette: Float[np.ndarray, "size size"],
        vertices_px: Float[np.ndarray, "V 2"],
        forehead_px: Float[np.ndarray, "2"],
        chin_px: Float[np.ndarray, "2"],
    ) -> Float[np.ndarray, "size size"]:
        """The region around a silhouette that was drawn before."""
        size = len(silhouette)
        face = float(np.linalg.norm(forehead_px - chin_px))
        distance = cv2.distanceTransform(
            (silhouette < 0.5).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5
        )
        wide = cv2.GaussianBlur(_grown(distance, _HAIR * face), (0, 0), 0.04 * face)
        narrow = cv2.GaussianBlur(_grown(distance, _MARGIN * face), (0, 0), 0.02 * face)
        height = height_above_chin(forehead_px, chin_px, size)
        skull = _smooth_step(height, 0.12, 0.4)
        if len(self._ring):
            up = (forehead_px - chin_px) / face
            ends = float(np.percentile((vertices_px[self._ring] - chin_px) @ up, 10)) / face
            # A ring that slants or a chin on the chest must not cut the face itself.
            low = min(ends, -_BELOW_CHIN - _FADE)
            narrow = narrow * _smooth_step(height, low, low + _FADE)
        return (skull * wide + (1 - skull) * narrow).astype(np.float32)


def height_above_chin(
    forehead_px: Float[np.ndarray, "2"], chin_px: Float[np.ndarray, "2"], size: int
) -> Float[np.ndarray, "size size"]:
    """How far up the face each pixel lies: 0 at the chin, 1 at the forehead."""
    along = (forehead_px - chin_px) / float(np.sum((forehead_px - chin_px) ** 2))
    places = np.arange(size, dtype=np.float32) + np.float32(0.5)
    columns = ((places - chin_px[0]) * along[0]).astype(np.float32)
    rows = ((places - chin_px[1]) * along[1]).astype(np.float32)
    return rows[:, None] + columns


def _grown(distance_px: Float[np.ndarray, "H W"], radius_px: float) -> Float[np.ndarray, "H W"]:
    return np.clip(radius_px - distance_px + 0.5, 0, 1)


def _smooth_step(
    values: Float[np.ndarray, "H W"], low: float, high: float
) -> Float[np.ndarray, "H W"]:
    share = np.clip((values - low) / (high - low), 0, 1)
    return share * share * (3 - 2 * share)
