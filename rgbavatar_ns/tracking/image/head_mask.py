"""Which part of the image the head mesh can explain: the matte fades out below its neck."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.drawing.wireframe import mesh_silhouette
from rgbavatar_ns.head.joints import ROOT

# Shares of the face's height (forehead to chin): how far hair may stand off the skull, how far
# skin may lie beside the fitted mesh, over what length the neck fades out, and how far below the
# chin nothing is cut.
_HAIR, _MARGIN, _FADE, _BELOW_CHIN = 0.4, 0.05, 0.12, 0.08
_OUTLINE_PX = 128


@dataclass(frozen=True)
class HeadOutline:
    """Where the fitted head lies in an image, at 128 pixels at most: no edge needs more."""

    silhouette: Float[np.ndarray, "s s"]
    """1 on the head and its neck, without shoulders, elsewhere 0."""
    above_chin: Float[np.ndarray, "s s"]
    """How far up the face each pixel lies: 0 at the chin, 1 at the forehead."""
    face_height_px: float
    """From forehead to chin, in pixels of the outline."""
    neck_end: float | None
    """How far up the face the mesh's lower border lies; None where it has none."""


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
    """Soft mask of the part of the image that the head (and not the shoulders) explains.

    The head is the part of the mesh that follows the neck joint more than the root. Above the
    chin its silhouette grows by the hair's margin; below it only by a little, and it fades out
    towards the ring at which this part ends.
    """

    def __init__(
        self, faces: Int[np.ndarray, "T 3"], skinning_weights: Float[np.ndarray, "V 5"]
    ) -> None:
        with_head = skinning_weights[:, ROOT] < 0.5
        self._faces = faces[with_head[faces].all(1)]
        self._ring = neck_ring(self._faces)

    def outline(
        self,
        vertices_px: Float[np.ndarray, "V 2"],
        forehead_px: Float[np.ndarray, "2"],
        chin_px: Float[np.ndarray, "2"],
        size: int,
    ) -> HeadOutline:
        """The outline in a square image of `size` pixels, in whose pixels points are given."""
        few = min(size, _OUTLINE_PX)
        vertices, forehead, chin = (
            few / size * points for points in (vertices_px, forehead_px, chin_px)
        )
        face = float(np.linalg.norm(forehead - chin))
        end = None
        if len(self._ring):
            up = (forehead - chin) / face
            end = float(np.percentile((vertices[self._ring] - chin) @ up, 10)) / face
        return HeadOutline(
            mesh_silhouette(vertices, self._faces, few),
            height_above_chin(forehead, chin, few),
            face,
            end,
        )

    def __call__(self, outline: HeadOutline, size: int) -> Float[np.ndarray, "size size"]:
        """1 on head and neck, 0 below."""
        face, height = outline.face_height_px, outline.above_chin
        distance = cv2.distanceTransform(
            (outline.silhouette < 0.5).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5
        )
        wide = cv2.GaussianBlur(_grown(distance, _HAIR * face), (0, 0), 0.04 * face)
        narrow = cv2.GaussianBlur(_grown(distance, _MARGIN * face), (0, 0), 0.02 * face)
        skull = _smooth_step(height, 0.12, 0.4)
        if outline.neck_end is not None:
            # A ring that slants or a chin on the chest must not cut the face itself.
            low = min(outline.neck_end, -_BELOW_CHIN - _FADE)
            narrow = narrow * _smooth_step(height, low, low + _FADE)
        mask = (skull * wide + (1 - skull) * narrow).astype(np.float32)
        return cv2.resize(mask, (size, size))


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
