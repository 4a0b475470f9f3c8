"""Attributes as functions of place and theta: positional encoding and multilayer perceptrons."""

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from rgbavatar_ns.avatar.model.weight_network import seeded_linear


def positional_encoding(x: Float[Tensor, "*n D"], octaves: int) -> Float[Tensor, "*n E"]:
    """x itself, then sin(2^k x) and cos(2^k x) for each of the octaves: D (1 + 2 octaves) numbers.

    Source: NeRF (Mildenhall et al. 2020, eq. 4) as its code has it, without pi; FlashAvatar takes 8
    octaves of metres.
    """
    waves = [wave(2.0**octave * x) for octave in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], -1)


class MLP(nn.Module):
    """`depth` hidden layers of one width, each with its activation, and a linear output.

    The input is the concatenation of parts that broadcast against each other, say the codes of N
    places [1, N, P] and a theta for each of B images [B, 1, T]: the first layer takes each part by
    itself and adds, so that nothing is repeated N or B times. With `skip_at` = k the k-th hidden
    layer (from 0) takes the input again, behind what the last one gave. Initial values are those of
    `torch.nn.Linear`, drawn from `generator`, those of the output times `last_scale`: with 0 the
    field begins at nothing.
    """

    def __init__(
        self,
        part_widths: Sequence[int],
        width: int,
        depth: int,
        num_out: int,
        *,
        generator: torch.Generator,
        skip_at: int | None = None,
        activation: Literal["relu", "softplus"] = "relu",
        last_scale: float = 1.0,
    ) -> None:
        super().__init__()
        if depth < 1 or (skip_at is not None and not 0 < skip_at < depth):
            raise ValueError(
                f"skip_at is {skip_at} of {depth} hidden layers. Pass one of 1 to - 1."
            )
        self.part_widths, self.skip_at = tuple(part_widths), skip_at
        self.activation: Literal["relu", "softplus"] = activation
        num_in = sum(part_widths)
        self.hidden = nn.ModuleList(
            seeded_linear(
                (num_in if k == 0 else width) + (num_in if k == skip_at else 0), width, generator
            )
            for k in range(depth)
        )
        self.output = seeded_linear(width, num_out, generator)
        with torch.no_grad():
            self.output.weight.mul_(last_scale)
            self.output.bias.mul_(last_scale)

    def forward(self, *parts: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """Values at every combination of the parts; raises ValueError for parts of other widths."""
        found = tuple(part.shape[-1] for part in parts)
        if found != self.part_widths:
            raise ValueError(f"The parts are {found} wide. Pass {self.part_widths}.")
        values = None
        for index, layer in enumerate(self.hidden):
            assert isinstance(layer, nn.Linear)
            if values is None:
                values = _of_parts(parts, layer.weight, layer.bias)
            elif index == self.skip_at:
                own = values.shape[-1]
                values = F.linear(values, layer.weight[:, :own], layer.bias)
                values = values + _of_parts(parts, layer.weight[:, own:], None)
            else:
                values = layer(values)
            # In place: neither the layer nor the activation looks back at it.
            relu = self.activation == "relu"
            values = F.relu(values, inplace=True) if relu else F.softplus(values, beta=100)
        return self.output(values)


def _of_parts(parts: tuple[Tensor, ...], weight: Tensor, bias: Tensor | None) -> Tensor:
    """A linear layer over the concatenation of parts, without it."""
    pieces = weight.split([part.shape[-1] for part in parts], 1)
    total = F.linear(parts[0], pieces[0], bias)
    for part, piece in zip(parts[1:], pieces[1:]):
        total = total + F.linear(part, piece)
    return total
