"""What is known at a mesh's vertices, anywhere on its surface."""

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
