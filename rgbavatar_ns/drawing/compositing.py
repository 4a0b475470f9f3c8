"""Pictures over a colour, with straight alpha, as bytes, and beside the truth."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

ERROR_GAIN = 4.0
"""By how much a shown error is larger than it is, so that 1/4 is white."""


def rgba_to_float(
    rgba: UInt8[Tensor, "*batch H W 4"] | Float[Tensor, "*batch H W 4"],
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "*batch H W 4"]:
    """Turn 8-bit RGBA into [0, 1]; floating values pass through."""
    if rgba.dtype == torch.uint8:
        return rgba.to(dtype).mul_(1 / 255)
    return rgba.to(dtype)


def composite(
    rgba: Float[Tensor, "*batch H W 4"], background: Float[Tensor, "*colors 3"]
) -> Float[Tensor, "*batch H W 3"]:
    """Lay straight-alpha images over one background colour each (or one for all)."""
    return torch.lerp(background[..., None, None, :], rgba[..., :3], rgba[..., 3:])


def straight_alpha(
    image: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W 1"]
) -> Float[Tensor, "H W 4"]:
    """RGBA of a picture over black: colour divided by alpha, black where nothing is seen."""
    return torch.cat([torch.where(alpha > 0, image / alpha.clamp(min=1e-6), 0.0), alpha], -1)


def to_uint8(image: Float[Tensor, "*batch H W C"]) -> UInt8[np.ndarray, "*batch H W C"]:
    """Values in [0, 1] as bytes, rounded; what lies outside is cut."""
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


def composite_bytes(
    rgba: UInt8[np.ndarray, "H W 4"], background: tuple[float, float, float]
) -> UInt8[np.ndarray, "H W 3"]:
    """`composite` of a picture's bytes over a colour in [0, 1]."""
    return to_uint8(composite(rgba_to_float(torch.from_numpy(rgba)), torch.tensor(background)))


def shown_error(
    image: Float[Tensor, "*batch H W 3"], truth: Float[Tensor, "*batch H W 3"]
) -> Float[Tensor, "*batch H W 3"]:
    """The absolute difference times `ERROR_GAIN`; not cut at 1."""
    return (image - truth).abs() * ERROR_GAIN


def error_strip(
    truth: Float[Tensor, "*batch H W 3"], image: Float[Tensor, "*batch H W 3"]
) -> Float[Tensor, "3 *batch H W 3"]:
    """Truth, image and shown error, each in [0, 1], to be put beside one another."""
    return torch.stack([truth, image, shown_error(image, truth)]).clamp(0, 1)
