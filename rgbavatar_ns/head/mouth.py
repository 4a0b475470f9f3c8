"""What lies behind a head's lips: the mouth's cavity, its teeth and its tongue."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from rgbavatar_ns.head.arrays import TEETH, TONGUE, HeadArrays
from rgbavatar_ns.head.landmarks import facemesh_landmarks

_INNER_RIMS = (
    *(78, 191, 80, 81, 82, 13, 312, 311, 310, 415),
    *(308, 324, 318, 402, 317, 14, 87, 178, 88, 95),
)
"""FaceMesh's points along the inner rims of the lips, once around."""


@dataclass(frozen=True)
class Mouth:
    """Where a head's mouth is on its mesh.

    Known of the embedded heads; `of` gives None for others, whose lips nobody has pointed out.
    """

    rim_vertices: Int[np.ndarray, "R 3"]
    """Triangles with the points of the lips' inner rims, once around."""
    rim_weights: Float[np.ndarray, "R 3"]
    """Where the points are in these; rows sum to one."""
    cavity: Int[np.ndarray, "C"]
    """Vertices of the skin that the rim cuts off from the face."""
    teeth: Int[np.ndarray, "T"]
    tongue: Int[np.ndarray, "G"]

    @classmethod
    def of(cls, arrays: HeadArrays) -> "Mouth | None":
        """The mouth of a head, if it is known where this one has it."""
        if HeadArrays.embedded_as(arrays.name) is None:
            return None
        marks = facemesh_landmarks()
        rows = [int(np.flatnonzero(marks.facemesh_index == point)[0]) for point in _INNER_RIMS]
        vertices, weights = arrays.faces[marks.triangle[rows]], marks.barycentric[rows]
        points_m = (arrays.v_template[vertices] * weights[..., None]).sum(1)
        _, nearest = KDTree(arrays.v_template).query(points_m)
        cavity = _cut_off(_edge_lengths(arrays), np.asarray(nearest).tolist())
        teeth, tongue = arrays.vertices_of(TEETH), arrays.vertices_of([TONGUE])
        return cls(vertices, weights, cavity, teeth, tongue)


def _edge_lengths(arrays: HeadArrays) -> sparse.csr_matrix:
    """The graph of the mesh: metres between the ends of each edge, on the template."""
    first, second = np.concatenate([arrays.faces[:, [k, (k + 1) % 3]] for k in range(3)]).T
    metres = np.linalg.norm(arrays.v_template[first] - arrays.v_template[second], axis=1)
    there = sparse.csr_matrix((metres, (first, second)), shape=2 * [len(arrays.v_template)])
    return sparse.csr_matrix(there.maximum(there.T))


def _cut_off(lengths: sparse.csr_matrix, stations: list[int]) -> Int[np.ndarray, "C"]:
    """What the closed way through these vertices in order parts from the most of their surface."""
    way: set[int] = set()
    for start, end in zip(stations, stations[1:] + stations[:1]):
        _, before = csgraph.dijkstra(lengths, indices=start, return_predecessors=True)
        while end != start:
            way.add(end)
            end = int(before[end])
    _, surface = csgraph.connected_components(lengths, directed=False)
    others = np.setdiff1d(np.flatnonzero(surface == surface[stations[0]]), list(way))
    _, part = csgraph.connected_components(lengths[others][:, others], directed=False)
    return others[part != np.bincount(part).argmax()]
