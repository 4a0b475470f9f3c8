"""When two measures of a head's shape are of one person, measured once."""

import torch
from jaxtyping import Float
from torch import Tensor

_ROUNDING = 1e-4
"""Coefficients are of size one."""


def is_same_identity(first: Float[Tensor, "I"], second: Float[Tensor, "K"]) -> bool:
    """Whether two identities are one but for rounding, wherever they lie.

    Of another person, another head model or the same person measured anew they are not.
    """
    if first.shape != second.shape:
        return False
    return torch.allclose(first.cpu().double(), second.cpu().double(), atol=_ROUNDING)
