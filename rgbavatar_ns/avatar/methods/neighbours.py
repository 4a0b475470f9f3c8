"""How far Gaussians lie apart, for scales to begin with."""

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor


def neighbour_distance(
    places: Float[Tensor, "N 3"], least: float = 1e-7**0.5
) -> Float[Tensor, "N"]:
    """Root of the mean squared distance to the three nearest others, at least `least`.

    In the unit of the places; of fewer than four, to those that there are. Source: Kerbl et al.
    2023, `create_from_pcd` of scene/gaussian_model.py, whose least is 1e-7 before the root.
    """
    points = places.detach().cpu().double().numpy()
    count = min(4, len(points))
    distance = torch.from_numpy(KDTree(points).query(points, k=count)[0]).reshape(-1, count)
    # The nearest is the point itself.
    mean = distance.square().sum(1) / max(count - 1, 1)
    return mean.sqrt().clamp(min=least).to(places)
