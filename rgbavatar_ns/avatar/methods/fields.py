"""Attributes as functions of place and theta: positional encoding and multilayer perceptrons."""

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from functools import cache
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rgbavatar_ns.avatar.model.weight_network import seeded_linear


def positional_encoding(x: Float[Tensor, "*n D"], octaves: int) -> Float[Tensor, "*n E"]:
    """x itself, then sin(2^k x) and cos(2^k x) for each of the octaves: D (1 + 2 octaves) numbers.

    Source: NeRF (Mildenhall et al. 2020, eq. 4) as its code has it, without pi; FlashAvatar takes 8
    octaves of metres.
    """
    waves = [wave(2.0**octave * x) for octave in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], -1)


Precision = Literal["auto", "float32", "bfloat16"]
"""In what a field's products are: with auto bfloat16 where a processor has instructions for it."""


def multiplied_in(precision: Precision, values: Tensor) -> torch.dtype:
    """The type in which `values` are multiplied: their own in double precision, and with auto on a
    GPU or a processor that does not multiply bfloat16 itself.
    """
    if precision == "float32" or values.dtype != torch.float32:
        return values.dtype
    if precision == "auto" and (values.device.type != "cpu" or not _has_bfloat16()):
        return torch.float32
    return torch.bfloat16


@cache
def _has_bfloat16() -> bool:
    """Whether this processor multiplies bfloat16 itself; False where torch cannot tell, and on
    ARM, where nobody has measured it."""
    asked = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(getattr(torch.cpu, name, bool)() for name in asked)


_SHARPNESS, _FLAT_FROM = 100.0, 0.2
_LINEAR_FROM = 20.0
"""Sharpness times x from which torch's softplus is x itself."""


def sharp_softplus(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """log(1 + exp(100 x)) / 100, whose tail below -.2 is flat: its 2e-11 are nothing beside 1.

    Without that, a few layers multiply tails to numbers below 1e-38, with which many processors
    take a hundred times as long as with others: ten times as long for a whole step on an Intel
    Xeon. Source: MonoGaussianAvatar (`geometry_network.py`); the flat tail is ours.
    """
    return _SharpSoftplus.apply(x)


class _SharpSoftplus(torch.autograd.Function):
    """`sharp_softplus`; autograd's gradient of the clamp takes longer than all the rest."""

    @staticmethod
    def forward(ctx: Any, x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        held = x.clamp(min=-_FLAT_FROM)
        ctx.save_for_backward(held)
        return F.softplus(held, beta=_SHARPNESS)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (held,) = ctx.saved_tensors
        slope = torch.ops.aten.softplus_backward(grad_outputs[0], held, _SHARPNESS, _LINEAR_FROM)
        return torch.ops.aten.threshold_backward(slope, held, -_FLAT_FROM)


class MLP(nn.Module):
    """`depth` hidden layers of one width, each with its activation, and a linear output.

    The input is the concatenation of parts that broadcast against each other, say the codes of N
    places [1, N, P] and a theta for each of B images [B, 1, T]: the first layer takes each part by
    itself and adds, so that nothing is repeated N or B times. With `skip_at` = k the k-th hidden
    layer (from 0) takes the input again, behind what the last one gave. Initial values are those of
    `torch.nn.Linear`, drawn from `generator`, those of the output times `last_scale`: with 0 the
    field begins at nothing. `precision` is that of the layers' products and what they give, but for
    an output that is narrower than they are: that one, parameters and their gradients are single.
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
        precision: Precision = "float32",
    ) -> None:
        super().__init__()
        self.precision: Precision = precision
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
        given, device = self.output.weight.dtype, self.output.weight.device.type
        narrow = multiplied_in(self.precision, self.output.weight)
        plain = self.activation == "relu" and self.skip_at is None
        weight, bias, *others = (
            p for layer in (*self.hidden, self.output) for p in layer.parameters()
        )
        # Numbers to draw with are narrower than layers; where they are as wide, others go on.
        exact = self.output.out_features < self.output.in_features
        with torch.autocast(device, narrow) if narrow != given else nullcontext():
            values = _of_parts(parts, weight, bias) if plain else self._hidden(parts)
            if not plain and not exact:
                values = self.output(values)
        if plain:
            return _ReluLayers.apply(exact, values, *others).to(given)
        return self.output(values.to(given)) if exact else values.to(given)

    def _hidden(self, parts: tuple[Tensor, ...]) -> Tensor:
        """What the hidden layers give, through autograd."""
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
            values = F.relu(values, inplace=True) if relu else sharp_softplus(values)
        assert values is not None
        return values


def _of_parts(parts: tuple[Tensor, ...], weight: Tensor, bias: Tensor | None) -> Tensor:
    """A linear layer over the concatenation of parts, without it."""
    pieces = weight.split([part.shape[-1] for part in parts], 1)
    total = F.linear(parts[0], pieces[0], bias)
    for part, piece in zip(parts[1:], pieces[1:]):
        total = total + F.linear(part, piece)
    return total


_BLOCK_ROWS = 1024
"""Rows that go through all layers together: what they hold stays within a core's cache."""
_ROUNDED_TO = 128
"""Rows of a gradient come in multiples of this many (`_rows_of`)."""


class _ReluLayers(torch.autograd.Function):
    """ReLU, then linear layers with ReLU between them, given as weight, bias, weight, bias ...

    The gradient is written out, because most of its rows may be 0: no picture shows what is behind
    the head, or covered. Such rows add exactly nothing, and most are left out. Values and
    gradients are those of autograd; there is no second derivative. Products are of the type of
    `first`, with `exact` those of the last layer, and sums over blocks of rows, of the layers' own.
    """

    @staticmethod
    def forward(
        ctx: Any, exact: bool, first: Float[Tensor, "..."], *layers: Tensor
    ) -> Float[Tensor, "..."]:
        rows, ctx.dtype = first.flatten(0, -2), layers[0].dtype
        weights, biases = ([x.to(first.dtype) for x in layers[k::2]] for k in (0, 1))
        if exact:
            weights[-1], biases[-1] = layers[-2], layers[-1]
        values = [torch.empty_like(rows)]
        values += [bias.new_empty(len(rows), len(bias)) for bias in biases]
        for block in _blocks(len(rows)):
            torch.clamp(rows[block], min=0, out=values[0][block])
            for k, (weight, bias) in enumerate(zip(weights, biases), 1):
                below = values[k - 1][block].to(weight.dtype)
                torch.addmm(bias, below, weight.mT, out=values[k][block])
                if k < len(weights):
                    values[k][block].clamp_(min=0)
        ctx.save_for_backward(*values[:-1], *weights)
        return values[-1].unflatten(0, first.shape[:-1])

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Tensor
    ) -> tuple[Tensor | None, ...]:
        saved, count = ctx.saved_tensors, len(ctx.saved_tensors) // 2
        hidden, weights = saved[:count], saved[count:]
        gradient = grad_outputs[0].flatten(0, -2)
        alive = _rows_of(gradient)
        of_first = torch.zeros_like(hidden[0])
        of_weights = [torch.zeros_like(weight, dtype=ctx.dtype) for weight in weights]
        of_biases = [weight.new_zeros(len(weight), dtype=ctx.dtype) for weight in weights]
        for block in _blocks(len(alive)):
            rows = alive[block]
            above = gradient[rows]
            for k in reversed(range(count)):
                below = hidden[k][rows]
                of_weights[k] += above.mT @ below.to(above.dtype)
                of_biases[k] += above.sum(0, dtype=ctx.dtype)
                above = (above @ weights[k]).to(below.dtype)
                above = torch.ops.aten.threshold_backward(above, below, 0)
            of_first[rows] = above
        of_layers = (part for pair in zip(of_weights, of_biases) for part in pair)
        return None, of_first.view(*grad_outputs[0].shape[:-1], -1), *of_layers


def _rows_of(gradient: Float[Tensor, "n C"]) -> Int[Tensor, "M"]:
    """Rows that are not all 0, and some that are, to make few different numbers of rows.

    For each size of a product oneDNN makes code of its own and keeps it: half a megabyte.
    """
    alive = (gradient != 0).any(1)
    rows = alive.nonzero()[:, 0]
    missing = -len(rows) % _ROUNDED_TO
    return torch.cat([rows, (~alive).nonzero()[:missing, 0]]) if missing else rows


def _blocks(count: int) -> Iterator[slice]:
    return (slice(start, start + _BLOCK_ROWS) for start in range(0, count, _BLOCK_ROWS))
