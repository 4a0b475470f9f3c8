"""The weight network F: theta's features to the blendshape weights psi (paper, eq. 2)."""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

_ROOM = 0.05
"""Of a number that never moved: radians, or shares of an expression."""


class WeightNetwork(nn.Module):
    """Three linear layers with ReLU between them, or a single one; no output activation.

    Paper, supplement: three layers, 128 wide; "linear" is its ablation. Initial values are those of
    `torch.nn.Linear`, drawn from `generator`.
    """

    def __init__(
        self,
        num_features: int,
        num_bases: int,
        *,
        kind: Literal["mlp", "linear"] = "mlp",
        hidden_width: int = 128,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        if kind == "linear":
            self.layers = nn.Sequential(seeded_linear(num_features, num_bases, generator))
        else:
            self.layers = nn.Sequential(
                seeded_linear(num_features, hidden_width, generator),
                nn.ReLU(),
                seeded_linear(hidden_width, hidden_width, generator),
                nn.ReLU(),
                seeded_linear(hidden_width, num_bases, generator),
            )

    def forward(self, features: Float[Tensor, "B F"]) -> Float[Tensor, "B K"]:
        """Map features to blendshape weights."""
        return self.layers(features)

    def linear_layers(self) -> list[nn.Linear]:
        """The layers with weights, in order."""
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]


def softly_within(
    theta: Float[Tensor, "*batch H"], low: Float[Tensor, "H"], high: Float[Tensor, "H"]
) -> Float[Tensor, "*batch H"]:
    """Theta as it is within a range; beyond, each number by itself goes ever less far.

    At most as far again as the range is wide, and .05. Where `low` is above `high` nothing is known
    and theta stays. Ours: weights of what training never saw ran away with its bases.
    """
    known = low <= high
    room = torch.where(known, high - low, 0) + _ROOM
    nearest = torch.where(known, torch.minimum(torch.maximum(theta, low), high), theta)
    return nearest + room * torch.tanh((theta - nearest) / room)


def seeded_linear(num_in: int, num_out: int, generator: torch.Generator) -> nn.Linear:
    """Build a linear layer with torch's default initial values drawn from `generator`."""
    # The global random state stays. (On "meta" nothing is drawn, but to begin with it takes .6 s.)
    with torch.random.fork_rng(devices=[]):
        layer = nn.Linear(num_in, num_out, device="cpu")
    bound = 1 / math.sqrt(num_in) if num_in > 0 else 0.0
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.uniform_(-bound, bound, generator=generator)
    return layer
