"""Nearest places on a head's skin, among those that look the same way and move alike."""

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.joints import EYES, JAW

# What counts as distance beside metres: a normal that points elsewhere (per unit), and another
# share in the jaw's motion, which keeps the upper lip apart from the lower one it rests on.
_NORMAL_M, _JAW_M = 0.01, 0.008
# The share of that once the alike are found: then it only has to part what lies face to face.
_EXACT_SHARE = 0.3
# Each triangle is sampled as often as gives about so many samples in all.
_SAMPLES, _MOST_SPLITS = 120_000, 6
_CANDIDATES = 12


@dataclass(frozen=True)
class SkinPoints:
    """Points on a head at rest, metres, with their outward normals and their share in the jaw."""

    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    jaw: Float[np.ndarray, "N"]

    def features(self, share: float = 1.0) -> Float[np.ndarray, "N 7"]:
        """Coordinates whose distance, in metres, says how unlike two points are.

        `share` is how much normal and jaw count beside the place.
        """
        normals, jaw = share * _NORMAL_M * self.normals, share * _JAW_M * self.jaw
        return np.concatenate([self.points, normals, jaw[:, None]], axis=1)

    def select(self, rows: Int[np.ndarray, "M"]) -> "SkinPoints":
        """These points, in this order."""
        return SkinPoints(self.points[rows], self.normals[rows], self.jaw[rows])

    def between(
        self, corners: Int[np.ndarray, "M 3"], barycentric: Float[np.ndarray, "M 3"]
    ) -> "SkinPoints":
        """Points within triangles of these points; their normals are not made of length 1."""
        return SkinPoints(
            np.einsum("nk,nkx->nx", barycentric, self.points[corners]),
            np.einsum("nk,nkx->nx", barycentric, self.normals[corners]),
            np.einsum("nk,nk->n", barycentric, self.jaw[corners]),
        )


@dataclass(frozen=True)
class SkinPlaces:
    """Where on a surface points were found: triangle of the head, barycentric place, the point
    there, and how unlike it is the one looked for, metres."""

    triangle: Int[np.ndarray, "N"]
    barycentric: Float[np.ndarray, "N 3"]
    found: SkinPoints
    unlike_m: Float[np.ndarray, "N"]


class SkinSurface:
    """The skin of a head at rest as a surface to search; eyeballs, teeth and tongue are no skin."""

    def __init__(self, arrays: HeadArrays) -> None:
        self._triangles = np.flatnonzero(is_skin(arrays)[arrays.faces].all(1))
        self._faces = arrays.faces[self._triangles].astype(np.int64)
        self._points = skin_points(arrays)
        splits = int(np.sqrt(2 * _SAMPLES / max(len(self._faces), 1)))
        splits = min(max(splits, 1), _MOST_SPLITS)
        steps = range(splits)
        grid = [(i, j, splits - 1 - i - j) for i in steps for j in steps if i + j < splits]
        places = (np.array(grid) + 1 / 3) / splits
        self._owners = np.repeat(np.arange(len(self._faces)), len(places))
        self._samples = self._at(self._owners, np.tile(places, (len(self._faces), 1)))
        self._tree = KDTree(self._samples.features())

    def sampled(self, points: SkinPoints) -> tuple[SkinPoints, Float[np.ndarray, "N"]]:
        """The sample of the surface that is most like each point, and how unlike it is, metres."""
        unlike_m, found = self._tree.query(points.features())
        return self._samples.select(np.atleast_1d(found)), np.atleast_1d(unlike_m)

    def nearest(self, points: SkinPoints) -> SkinPlaces:
        """The place of the surface that is most like each point."""
        _, samples = self._tree.query(points.features(), k=_CANDIDATES)
        rows = self._owners[samples].reshape(-1)
        corners = self._points.points[self._faces[rows]]
        closest = trimesh.triangles.closest_point(
            corners, np.repeat(points.points, _CANDIDATES, axis=0)
        )
        places = trimesh.triangles.points_to_barycentric(corners, closest).clip(0, 1)
        places /= places.sum(1, keepdims=True)
        candidates = self._at(rows, places)
        wanted = np.repeat(points.features(_EXACT_SHARE), _CANDIDATES, axis=0)
        apart = candidates.features(_EXACT_SHARE) - wanted
        unlike_m = np.linalg.norm(apart, axis=1).reshape(-1, _CANDIDATES)
        best = np.arange(len(unlike_m)) * _CANDIDATES + unlike_m.argmin(1)
        triangles = self._triangles[rows[best]]
        return SkinPlaces(triangles, places[best], candidates.select(best), unlike_m.min(1))

    def _at(self, rows: Int[np.ndarray, "N"], places: Float[np.ndarray, "N 3"]) -> SkinPoints:
        found = self._points.between(self._faces[rows], places)
        length = np.linalg.norm(found.normals, axis=1, keepdims=True) + 1e-12
        return replace(found, normals=found.normals / length)


def is_skin(arrays: HeadArrays) -> Bool[np.ndarray, "V"]:
    """Vertices of the skin: what the head's groups say, else all but the eyeballs."""
    if "skin" not in arrays.vertex_groups:
        return arrays.skinning_weights[:, EYES].max(1) <= 0.5
    skin = np.zeros(len(arrays.v_template), dtype=bool)
    skin[arrays.vertex_groups["skin"]] = True
    return skin


def skin_points(arrays: HeadArrays, placed: Float[np.ndarray, "V 3"] | None = None) -> SkinPoints:
    """All vertices of a head at rest, or as `placed`, with the normals of its skin."""
    vertices = arrays.v_template.astype(np.float64) if placed is None else placed
    faces = arrays.faces[is_skin(arrays)[arrays.faces].all(1)].astype(np.int64)
    jaw = arrays.skinning_weights[:, JAW].astype(np.float64)
    # Of the triangles around, weighed by area; 0 where there is none.
    a, b, c = vertices[faces].transpose(1, 0, 2)
    areas = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], areas)
    normals = normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12)
    return SkinPoints(vertices, normals, jaw)
