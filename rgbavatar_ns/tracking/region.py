"""Which part of the picture the head mesh can explain: the matte fades out below its neck."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

# Shares of the face's height (forehead to chin): how far hair may stand off the skull, how far
# skin may lie beside the fitted mesh, over what length the neck fades out, and how far below the
# chin nothing is cut.
_HAIR, _MARGIN, _FADE, _BELOW_CHIN = 0.4, 0.05, 0.12, 0.08


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


class HeadRegion:
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
        """1 on head and neck, 0 below, for a square image of `size` pixels."""
        face = float(np.linalg.norm(forehead_px - chin_px))
        up = (forehead_px - chin_px) / face
        silhouette = mesh_silhouette(vertices_px, self._faces, size)
        wide = cv2.GaussianBlur(_grown(silhouette, _HAIR * face), (0, 0), 0.04 * face)
        narrow = cv2.GaussianBlur(_grown(silhouette, _MARGIN * face), (0, 0), 0.02 * face)
        rows, columns = np.mgrid[0:size, 0:size] + 0.5
        height = (columns - chin_px[0]) * up[0] + (rows - chin_px[1]) * up[1]
        skull = _smooth_step(height / face, 0.12, 0.4)
        if len(self._ring):
            ends = float(np.percentile((vertices_px[self._ring] - chin_px) @ up, 10)) / face
            # A ring that slants or a chin on the chest must not cut the face itself.
            low = min(ends, -_BELOW_CHIN - _FADE)
            narrow = narrow * _smooth_step(height / face, low, low + _FADE)
        return (skull * wide + (1 - skull) * narrow).astype(np.float32)


def mesh_silhouette(
    vertices_px: Float[np.ndarray, "V 2"], faces: Int[np.ndarray, "T 3"], size: int
) -> Float[np.ndarray, "size size"]:
    """1 where any triangle covers the pixel, 0 elsewhere."""
    mask = np.zeros((size, size), np.uint8)
    fixed = np.round((vertices_px - 0.5) * 16).astype(np.int32)
    for triangle in fixed[faces[_facing(vertices_px, faces)]]:
        cv2.fillConvexPoly(mask, triangle, (1,), shift=4)
    return mask.astype(np.float32)


def _facing(
    vertices_px: Float[np.ndarray, "V 2"], faces: Int[np.ndarray, "T 3"]
) -> Bool[np.ndarray, "T"]:
    """Triangles seen from outside: wound counterclockwise as seen, with y down."""
    a, b, c = (vertices_px[faces[:, corner]] for corner in range(3))
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _grown(mask: Float[np.ndarray, "H W"], radius_px: float) -> Float[np.ndarray, "H W"]:
    outside = (mask < 0.5).astype(np.uint8)
    distance = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.clip(radius_px - distance + 0.5, 0, 1).astype(np.float32)


def _smooth_step(
    values: Float[np.ndarray, "H W"], low: float, high: float
) -> Float[np.ndarray, "H W"]:
    share = np.clip((values - low) / (high - low), 0, 1)
    return share * share * (3 - 2 * share)
