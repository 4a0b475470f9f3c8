"""Where Gaussians begin on a mesh."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

_CANDIDATES = 4
_APART = 0.7
"""In roots of the area a point has; .83 is about the most that points at random reach."""


def spread_points(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    count: int,
    generator: torch.Generator,
) -> tuple[Int[Tensor, "N"], Float[Tensor, "N 3"]]:
    """Triangles and barycentric coordinates of points spread evenly over a mesh, apart.

    Darts are thrown at the area, four for each point, and one too near to an earlier one is kept
    only where points are missing in the end: nearly Poisson disks, but exactly as many as asked.
    """
    corner, second, third = (part.cpu().double() for part in vertices[faces].unbind(1))
    area = 0.5 * torch.linalg.cross(second - corner, third - corner).norm(dim=-1)
    darts = _CANDIDATES * count
    drawn = torch.rand(darts, 3, generator=generator, dtype=torch.float64)
    whole = area.cumsum(0)
    triangle = torch.searchsorted(whole, drawn[:, 0] * whole[-1]).clamp(max=len(faces) - 1)
    u, v = drawn[:, 1].sqrt(), drawn[:, 2]
    barycentric = torch.stack([1 - u, u * (1 - v), u * v], 1)
    corners = torch.stack([corner, second, third], 1)[triangle]
    places = (corners * barycentric[..., None]).sum(1)
    apart = _APART * float(whole[-1] / count) ** 0.5
    free = torch.from_numpy(_free_of_earlier(places.numpy(), apart))
    kept = torch.argsort((~free).int(), stable=True)[:count].sort().values
    return triangle[kept].to(faces), barycentric[kept].to(vertices)


def _free_of_earlier(places: Float[np.ndarray, "M 3"], apart: float) -> Bool[np.ndarray, "M"]:
    """Which are kept if each in turn is, unless one that is kept lies nearer than `apart`."""
    pairs = KDTree(places).query_pairs(apart, output_type="ndarray")
    kept, open_ = np.zeros(len(places), bool), np.ones(len(places), bool)
    while open_.any():
        # Those without an undecided earlier neighbour stay, and rule their later neighbours out.
        first = open_.copy()
        first[pairs[:, 1]] = False
        kept |= first
        open_ &= ~first
        open_[pairs[first[pairs[:, 0]], 1]] = False
        pairs = pairs[open_[pairs].all(1)]
    return kept
