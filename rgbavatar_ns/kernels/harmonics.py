"""Colours out of spherical harmonics, without tensor operations.

The readable path is `avatar.methods.sh.sh_colors` in torch; this one gives the same numbers and is
only faster.
"""

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.registry import choose

_COUNTS = (4, 9, 16)


def harmonic_colors(
    coefficients: Float[Tensor, "#B N C 3"],
    directions: Float[Tensor, "B N 3"],
    backend: str = "auto",
) -> Float[Tensor, "B N 3"] | None:
    """Colours .5 + sum Y_k(d) c_k, not below 0, seen along unit vectors; differentiable.

    None where the chosen backend has no loops for it. Raises ValueError unless there are 4, 9 or 16
    coefficients for each direction, and where there is no such backend.
    """
    own, along = tuple(coefficients.shape), tuple(directions.shape)
    images = along[0] if along else 0
    fits = own in {(b, *along[1:2], c, 3) for b in (1, images) for c in _COUNTS}
    if not fits or len(along) != 3 or along[2] != 3:
        raise ValueError(
            f"Coefficients are {list(own)}, directions {list(along)}. Pass [B or 1, N, C, 3] and "
            "[B, N, 3], with C one of 4, 9 and 16."
        )
    chosen = choose(backend, coefficients.device, coefficients.dtype)
    return chosen.harmonic_colors(coefficients, directions)
