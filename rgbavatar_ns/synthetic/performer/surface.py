"""The person's true surface: finer than the tracked mesh, with hair and folds that it lacks."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.synthetic.performer import regions
from rgbavatar_ns.synthetic.performer.noise import fractal_noise
from rgbavatar_ns.synthetic.performer.paint import wrinkle_heights_m
from rgbavatar_ns.synthetic.performer.regions import smooth

PARTS = ("skin", "left_eye", "right_eye", "upper_teeth", "lower_teeth", "tongue")
Vertices = Float[np.ndarray, "V 3"]
Faces = Int[np.ndarray, "F 3"]


def split_in_four(faces: Faces, count: int) -> tuple[Int[np.ndarray, "F4 3"], sparse.csr_matrix]:
    """Cut each triangle at its edges' middles; new faces, and the matrix old -> new vertices."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, 1)], 2).reshape(-1, 2), 1)
    ends, middle = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = (count + middle.reshape(-1, 3)).T
    p, q, r = faces.T
    quarters = [[p, a, c], [a, q, b], [c, b, r], [a, b, c]]
    split = np.stack([np.stack(quarter, 1) for quarter in quarters], 1).reshape(-1, 3)
    rows = np.repeat(np.arange(len(ends)), 2)
    halves = sparse.csr_matrix(
        (np.full(ends.size, 0.5, np.float32), (rows, ends.ravel())), (len(ends), count)
    )
    same = sparse.csr_matrix((np.ones(count, np.float32), (range(count), range(count))))
    return split, sparse.csr_matrix(sparse.vstack([same, halves]))


def incidence(faces: Faces, count: int) -> sparse.csr_matrix:
    """The matrix that sums the values of the faces around each vertex."""
    columns = np.repeat(np.arange(len(faces)), 3)
    ones = np.ones(faces.size, np.float32)
    return sparse.csr_matrix((ones, (faces.ravel(), columns)), (count, len(faces)))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length one; zero stays zero."""
    length = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None]
    return vectors / np.maximum(length, 1e-20)


def face_normals(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "F 3"]:
    """Outward normals, as long as twice the triangle's area."""
    first, second, third = (vertices[faces[:, k]] for k in range(3))
    return np.cross(second - first, third - first)


@dataclass(frozen=True)
class PosedSurface:
    """The true surface in one frame, world space."""

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    """Smooth, without the folds, which the slope texture tilts."""


class TrueSurface:
    """Makes the true surface out of the head model's vertices.

    Every triangle of the tracked mesh becomes four; hair stands off the scalp, heavier on the
    side that hangs down; folds rise and sink with their activations. `scalp_hair` is how high hair
    stands, by the height of a short cut.
    """

    def __init__(
        self, arrays: HeadArrays, seed: int, wrinkles: float, scalp_hair: float = 1.0
    ) -> None:
        count = len(arrays.v_template)
        self._coarse_faces = arrays.faces
        self.faces, self._split = split_in_four(arrays.faces, count)
        self.uv_faces, uv_split = split_in_four(arrays.uv_faces, len(arrays.uv))
        self.uv = (uv_split @ arrays.uv).astype(np.float32)
        self.template = (self._split @ arrays.v_template).astype(np.float32)
        corners = arrays.uv[arrays.uv_faces].astype(np.float64)
        self._uv_inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1]).astype(np.float32)
        self._edge_ends = self._split.indices[count:].reshape(-1, 2)
        depth = self.template[count:, 2]
        self._roundness = (0.8 * smooth(depth, 0.03, 0.0)).astype(np.float32)
        self._coarse_incidence = incidence(arrays.faces, count)
        self._incidence = incidence(self.faces, len(self.template))
        part_of_vertex = np.zeros(count, np.int8)
        for number, part in enumerate(PARTS):
            part_of_vertex[arrays.vertex_groups[part]] = number
        self.face_part = np.repeat(part_of_vertex[arrays.faces[:, 0]], 4)
        skin = (self._split @ (part_of_vertex == 0).astype(np.float32) > 0.99).astype(np.float32)
        above = regions.above_hairline_m(self.template)
        locks = 1 + 0.45 * fractal_noise(self.template * 55, seed + 12, 2)
        full = scalp_hair * (0.0055 + 0.0085 * smooth(self.template[:, 1], 0.05, 0.12))
        self._hair_m = (full * locks * smooth(above, -0.001, 0.022) * skin).astype(np.float32)
        self._folds_m = wrinkle_heights_m(self.template) * (skin * np.float32(wrinkles))[:, None]

    def _rounded(
        self, tracked: Float[np.ndarray, "C 3"], normals: Float[np.ndarray, "C 3"]
    ) -> Float[np.ndarray, "V 3"]:
        """Vertices after splitting; skull and neck, coarse in the head model, are rounded.

        Phong tessellation (Boubekeur and Alexa 2008): an edge's middle moves towards the planes
        that touch the surface at its ends.
        """
        fine = (self._split @ tracked).astype(np.float32)
        middle = fine[len(tracked) :].copy()
        for end in self._edge_ends.T:
            n = normals[end]
            height = ((middle - tracked[end]) * n).sum(1)
            fine[len(tracked) :] -= (0.5 * self._roundness * height)[:, None] * n
        return fine

    def tangents(
        self, tracked: Vertices
    ) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
        """Unit directions of growing u and growing v on each of the tracked mesh's T triangles."""
        first, second, third = (tracked[self._coarse_faces[:, k]] for k in range(3))
        edges = np.stack([second - first, third - first], 1)
        tangents = unit(self._uv_inverse @ edges)
        return tangents[:, 0], tangents[:, 1]

    def pose(
        self, tracked: Vertices, activations: Float[np.ndarray, "W"], tilt: float = 0.0
    ) -> PosedSurface:
        """The surface over the tracked mesh's vertices; `tilt` is how far hair hangs to +x."""
        coarse_normals = unit(self._coarse_incidence @ face_normals(tracked, self._coarse_faces))
        fine = self._rounded(tracked, coarse_normals)
        out = unit(self._split @ coarse_normals).astype(np.float32)
        hair = self._hair_m * (1 + np.float32(tilt) * out[:, 0])
        haired = fine + out * hair[:, None]
        normals = unit(self._incidence @ face_normals(haired, self.faces))
        folded = haired + out * (self._folds_m @ activations.astype(np.float32))[:, None]
        return PosedSurface(folded.astype(np.float32), normals.astype(np.float32))
