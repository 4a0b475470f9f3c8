"""Which triangle lies under each texel of the UV map, and where in the triangle."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

_INSIDE = -1e-9
"""A centre this little outside of an edge still counts, so that shared edges leave no gap."""


@dataclass(frozen=True)
class UVAnchors:
    """N covered texels of a `resolution` x `resolution` map, by row and column.

    Texel (row r, column c) has its centre at u = (c + .5) / resolution, v = 1 - (r + .5) /
    resolution; row 0 is the top.
    """

    triangle_index: Int[Tensor, "N"]
    barycentric: Float[Tensor, "N 3"]
    """Non-negative, sums to one."""
    texel_row_col: Int[Tensor, "N 2"]
    resolution: int


@torch.no_grad()
def uv_anchors(
    uv: Float[Tensor, "VT 2"], uv_faces: Int[Tensor, "F 3"], resolution: int
) -> UVAnchors:
    """Every texel whose centre a triangle of the UV map covers (as the release places Gaussians).

    Where several triangles cover a centre (a shared edge, an overlap) the first in the list wins.
    Triangles without area carry no texel. Barycentrics have the dtype of `uv`; the search runs in
    float64. Raises ValueError for a resolution below 1.
    """
    if resolution < 1:
        raise ValueError(f"resolution is {resolution}; at least 1 is needed")
    corners = uv.double()[uv_faces]
    # In texel coordinates a centre has whole numbers: x to the right, y downwards.
    x = corners[..., 0] * resolution - 0.5
    y = (1 - corners[..., 1]) * resolution - 0.5
    triangle, column, row = _candidates(x, y, resolution)
    weights, inside = _barycentric(x[triangle], y[triangle], column, row)
    triangle, column, row = triangle[inside], column[inside], row[inside]
    weights = weights[inside].clamp(min=0)
    weights = weights / weights.sum(1, keepdim=True)
    # Sorted by texel, then triangle: of each texel the first is kept.
    order = torch.argsort((row * resolution + column) * len(uv_faces) + triangle)
    texel = (row * resolution + column)[order]
    first = torch.ones_like(texel, dtype=torch.bool)
    first[1:] = texel[1:] != texel[:-1]
    chosen = order[first]
    return UVAnchors(
        triangle[chosen],
        weights[chosen].to(uv.dtype),
        torch.stack([row[chosen], column[chosen]], 1),
        resolution,
    )


def _candidates(
    x: Float[Tensor, "F 3"], y: Float[Tensor, "F 3"], resolution: int
) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"], Int[Tensor, "M"]]:
    """Triangle, column and row of every texel centre in every triangle's bounding box."""
    slack = 1e-6
    left = (x.amin(1) - slack).ceil().clamp(min=0).long()
    top = (y.amin(1) - slack).ceil().clamp(min=0).long()
    width = ((x.amax(1) + slack).floor().clamp(max=resolution - 1).long() - left + 1).clamp(min=0)
    height = ((y.amax(1) + slack).floor().clamp(max=resolution - 1).long() - top + 1).clamp(min=0)
    count = width * height
    triangle = torch.repeat_interleave(torch.arange(len(x), device=x.device), count)
    start = count.cumsum(0) - count
    place = torch.arange(len(triangle), device=x.device) - start[triangle]
    column = left[triangle] + place % width[triangle]
    row = top[triangle] + torch.div(place, width[triangle], rounding_mode="floor")
    return triangle, column, row


def _barycentric(
    x: Float[Tensor, "M 3"],
    y: Float[Tensor, "M 3"],
    column: Int[Tensor, "M"],
    row: Int[Tensor, "M"],
) -> tuple[Float[Tensor, "M 3"], Tensor]:
    """Barycentric coordinates of texel centres, and whether they lie inside."""
    dx, dy = x - column[:, None], y - row[:, None]
    doubled = dx * dy.roll(-1, 1) - dy * dx.roll(-1, 1)
    # doubled[i] belongs to edge i -> i+1, opposite of corner i+2.
    area = doubled.roll(-1, 1)
    total = area.sum(1, keepdim=True)
    has_area = total.abs() > 1e-9
    weights = area / torch.where(has_area, total, 1.0)
    return weights, has_area[:, 0] & (weights > _INSIDE).all(1)
