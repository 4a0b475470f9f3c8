"""The compiled loops for colours out of spherical harmonics."""

import os
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from rgbavatar_ns.kernels.cpu import (
    INSTRUCTION_SET_VARIABLE,
    _native,  # pyright: ignore[reportMissingModuleSource]
)


def compiled_harmonic_colors(
    coefficients: Float[Tensor, "#B N C 3"], directions: Float[Tensor, "B N 3"]
) -> Float[Tensor, "B N 3"]:
    """See `kernels.harmonics.harmonic_colors`; there is no second derivative."""
    return _HarmonicColors.apply(coefficients, directions)


class _HarmonicColors(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, coefficients: Float[Tensor, "#B N C 3"], directions: Float[Tensor, "B N 3"]
    ) -> Float[Tensor, "B N 3"]:
        own, along = coefficients.detach().contiguous(), directions.detach().contiguous()
        colors = torch.empty_like(along)
        threads, instruction_set = _how()
        _native.harmonic_colors(own, along, colors, threads, instruction_set)
        ctx.save_for_backward(own, along)
        return colors

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Tensor
    ) -> tuple[Tensor, Tensor]:
        own, along = ctx.saved_tensors
        of_own, of_along = torch.empty_like(own), torch.empty_like(along)
        threads, instruction_set = _how()
        _native.harmonic_gradient(
            own, along, grad_outputs[0].contiguous(), of_own, of_along, threads, instruction_set
        )
        return of_own, of_along


def _how() -> tuple[int, str]:
    """Threads and instruction set."""
    return torch.get_num_threads(), os.environ.get(INSTRUCTION_SET_VARIABLE, "")
