"""What a tracker gets wrong in every frame alike, as a linear map from what it says."""

import torch
from jaxtyping import Float
from torch import Tensor

_BLOCKS = 5
_RIDGES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Tried weights of the ridge, as multiples of the number of frames; the map may also be zero."""


def fit_ridge(inputs: Float[Tensor, "F M"], outputs: Float[Tensor, "F H"]) -> Float[Tensor, "M H"]:
    """The linear map from inputs to outputs, each output's ridge chosen by what it predicts.

    Both are thought to be centred. A ridge is judged on five blocks of successive frames, each
    predicted from the others. An output that no ridge predicts better than zero gets zero.
    """
    ridges = inputs.new_tensor(_RIDGES) * len(inputs)
    error = outputs.new_zeros(len(ridges) + 1, outputs.shape[1])
    for held_out in torch.arange(len(inputs), device=inputs.device).chunk(_BLOCKS):
        others = torch.ones(len(inputs), dtype=torch.bool, device=inputs.device)
        others[held_out] = False
        maps = _ridge_maps(inputs[others], outputs[others], ridges)
        maps = torch.cat([maps, torch.zeros_like(maps[:1])])
        error += (inputs[held_out] @ maps - outputs[held_out]).square().sum(1)
    maps = _ridge_maps(inputs, outputs, ridges)
    maps = torch.cat([maps, torch.zeros_like(maps[:1])])
    best = error.argmin(0)
    return maps.gather(0, best.expand(1, inputs.shape[1], -1))[0]


def _ridge_maps(
    inputs: Float[Tensor, "F M"], outputs: Float[Tensor, "F H"], ridges: Float[Tensor, "L"]
) -> Float[Tensor, "L M H"]:
    """The minimiser of |inputs W - outputs|^2 + ridge |W|^2 for each ridge."""
    sizes, directions = torch.linalg.eigh(inputs.mT @ inputs)
    along = directions.mT @ (inputs.mT @ outputs)
    return directions @ (along / (sizes.clamp(min=0) + ridges[:, None])[..., None])
