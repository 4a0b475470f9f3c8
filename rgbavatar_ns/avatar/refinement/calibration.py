"""What a tracker gets wrong in every frame alike, as a linear map from what it says."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

_BLOCKS = 5
_RIDGES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Tried weights of the ridge, as multiples of the number of frames; the map may also be zero."""


def fit_ridge(inputs: Float[Tensor, "F M"], outputs: Float[Tensor, "F H"]) -> Float[Tensor, "M H"]:
    """The linear map from inputs to outputs, each output's ridge chosen by what it predicts.

    Both are thought to be centred. A ridge is judged on five blocks of successive frames, each
    predicted from the others. Of those that predict an output as well as the best one, to within
    its standard error, the largest is taken, and zero where that is one of them (Breiman et al.
    1984): of sixty frames the best one is often the best by chance.
    """
    ridges = inputs.new_tensor(_RIDGES) * len(inputs)
    errors, frames = [], torch.arange(len(inputs), device=inputs.device)
    for held_out in frames.tensor_split(min(_BLOCKS, len(inputs))):
        others = torch.ones(len(inputs), dtype=torch.bool, device=inputs.device)
        others[held_out] = False
        maps = _ridge_maps(inputs[others], outputs[others], ridges)
        maps = torch.cat([maps, torch.zeros_like(maps[:1])])
        errors.append((inputs[held_out] @ maps - outputs[held_out]).square().sum(1))
    maps = _ridge_maps(inputs, outputs, ridges)
    maps = torch.cat([maps, torch.zeros_like(maps[:1])])
    chosen = _simplest(torch.stack(errors))
    return maps.gather(0, chosen.expand(1, inputs.shape[1], -1))[0]


def _simplest(errors: Float[Tensor, "K L H"]) -> Int[Tensor, "H"]:
    """The last of L choices whose error over K blocks is within a standard error of the best."""
    mean = errors.mean(0)
    best = mean.argmin(0, keepdim=True)
    spread = errors.std(0, correction=min(1, len(errors) - 1)).gather(0, best)
    good = mean <= mean.gather(0, best) + spread / len(errors) ** 0.5
    numbers = torch.arange(len(mean), device=mean.device)[:, None]
    return torch.where(good, numbers, 0).amax(0)


def _ridge_maps(
    inputs: Float[Tensor, "F M"], outputs: Float[Tensor, "F H"], ridges: Float[Tensor, "L"]
) -> Float[Tensor, "L M H"]:
    """The minimiser of |inputs W - outputs|^2 + ridge |W|^2 for each ridge."""
    sizes, directions = torch.linalg.eigh(inputs.mT @ inputs)
    along = directions.mT @ (inputs.mT @ outputs)
    return directions @ (along / (sizes.clamp(min=0) + ridges[:, None])[..., None])
