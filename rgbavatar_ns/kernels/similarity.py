"""Mean structural similarity (SSIM) and its gradient, without tensor operations.

The readable path is `avatar.methods.loss_terms.dssim_loss` in torch; this one gives the same
numbers and is only faster.
"""

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.registry import choose

_TAPS = 11


def mean_similarity(
    image: Float[Tensor, "B H W 3"],
    target: Float[Tensor, "B H W 3"],
    window: Float[Tensor, "11"],
    stabilizers: tuple[float, float],
    *,
    with_gradient: bool = False,
    backend: str = "auto",
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B H W 3"] | None] | None:
    """Mean SSIM of each pair over the windows that lie within it, and its gradient by `image`.

    None where the chosen backend has no loops for it. `window` is symmetric and taken along both
    sides, `stabilizers` are C1 and C2 of Wang et al. 2004, eq. 13. Raises ValueError for pictures
    below 11 x 11, of two shapes or not of three channels, for another window's length, and where
    there is no such backend.
    """
    if window.shape != (_TAPS,):
        raise ValueError(f"The window is {list(window.shape)}. Pass [{_TAPS}].")
    shape = tuple(image.shape)
    if shape != target.shape or len(shape) != 4 or shape[3] != 3 or min(shape[1:3]) < _TAPS:
        raise ValueError(
            f"Pictures are {list(shape)} and {list(target.shape)}. Pass pairs [B, H, W, 3], of "
            f"{_TAPS} x {_TAPS} pixels or more."
        )
    chosen = choose(backend, image.device, image.dtype)
    return chosen.mean_similarity(image, target, window, stabilizers, with_gradient=with_gradient)
