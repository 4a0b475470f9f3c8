"""What is known at a mesh's vertices, anywhere on its surface."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor


def vertex_normals(
    vertices: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "B V 3"]:
    """Unit normals, each the mean of the faces around it by area."""
    first, second, third = (vertices[:, faces[:, k]] for k in range(3))
    normals = torch.linalg.cross(second - first, third - first)
    sums = torch.zeros_like(vertices)
    for corner in range(3):
        sums.index_add_(1, faces[:, corner], normals)
    return F.normalize(sums, dim=-1)


def interpolated(
    values: Float[Tensor, "B V C"],
    corners: Int[Tensor, "N 3"],
    barycentric: Float[Tensor, "N 3"],
) -> Float[Tensor, "B N C"]:
    """Values of vertices at N places of triangles; gradients reach values and places."""
    # The batch lies innermost, so that each vertex is fetched once for all images.
    table = values.transpose(0, 1).flatten(1)
    summed = F.embedding_bag(corners, table, per_sample_weights=barycentric, mode="sum")
    return summed.view(len(corners), len(values), -1).transpose(0, 1).contiguous()


@dataclass(frozen=True)
class MeshEdges:
    """The edges of a mesh, each once, by their lower and then their higher vertex."""

    ends: Int[Tensor, "E 2"]
    num_faces: Int[Tensor, "E"]
    """Around each edge: one at the mesh's border."""
    of_faces: Int[Tensor, "F 3"]
    """Each face's edges: from its first corner to its second, second to third, third to first."""

    @classmethod
    def of(cls, faces: Int[Tensor, "F 3"]) -> "MeshEdges":
        """Find them; a number for each edge is sorted in a thirtieth of the time of its ends."""
        ends = torch.stack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]], 1)
        low, high = ends.sort(-1).values.unbind(-1)
        count = 1 + int(faces.max()) if len(faces) else 1
        numbers, of_faces, num_faces = torch.unique(
            low * count + high, return_inverse=True, return_counts=True
        )
        ends = torch.stack([numbers // count, numbers % count], 1)
        return cls(ends, num_faces, of_faces)
