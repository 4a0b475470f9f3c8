"""Pictures over a colour, with straight alpha, as bytes, and beside the truth.

A pixel of `UNFILMED_RGBA` shows nothing: it is drawn as background, and counts for nothing.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from rgbavatar_ns.threads import using_threads

ImagesRGBA = UInt8[Tensor, "*batch height width 4"] | Float[Tensor, "*batch height width 4"]
"""Straight-alpha images, of 8 bits or in [0, 1]."""
_UNFILMED = int(np.array(UNFILMED_RGBA, np.uint8).view(np.int32)[0])
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


def is_unfilmed(
    rgba: UInt8[Tensor, "*batch H W 4"] | Float[Tensor, "*batch H W 4"],
) -> Bool[Tensor, "*batch H W"]:
    """Where straight-alpha images say that nobody filmed a pixel: exactly `UNFILMED_RGBA`."""
    if rgba.dtype != torch.uint8:
        rgba = (rgba.detach() * 255).round().clamp(0, 255).to(torch.uint8)
    # Four bytes as one number: a tenth of the time.
    return (rgba.contiguous().view(torch.int32) == _UNFILMED).squeeze(-1)


def unfilmed_pixels(rgba: UInt8[np.ndarray, "H W 4"]) -> Bool[np.ndarray, "H W"]:
    """`is_unfilmed` of a picture's bytes; without torch, whose threads cost more here."""
    return (np.ascontiguousarray(rgba).view(np.int32) == _UNFILMED)[..., 0]


def all_filmed(rgba: UInt8[np.ndarray, "H W 4"]) -> UInt8[np.ndarray, "H W 4"]:
    """The picture with background in the place of marks, as of a source that marks nothing."""
    unfilmed = unfilmed_pixels(rgba)
    return np.where(unfilmed[..., None], np.uint8(0), rgba) if unfilmed.any() else rgba


def film_over(
    rgba: UInt8[Tensor, "*batch H W 4"] | Float[Tensor, "*batch H W 4"],
    background: Float[Tensor, "*colors 3"],
    otherwise: Float[Tensor, "*batch H W 3"],
) -> Float[Tensor, "*batch H W 3"]:
    """`composite`, and `otherwise` where nobody filmed: there it has no error."""
    over = composite(rgba_to_float(rgba, otherwise.dtype), background)
    return torch.where(is_unfilmed(rgba)[..., None], otherwise, over)


def straight_alpha(
    image: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W 1"]
) -> Float[Tensor, "H W 4"]:
    """RGBA of a picture over black: colour divided by alpha, black where nothing is seen."""
    return torch.cat([torch.where(alpha > 0, image / alpha.clamp(min=1e-6), 0.0), alpha], -1)


def to_uint8(image: Float[Tensor, "*batch H W C"]) -> UInt8[np.ndarray, "*batch H W C"]:
    """Values in [0, 1] as bytes, rounded; what lies outside is cut."""
    with using_threads(1):  # The next picture's loops are about to begin.
        levels = torch.add(0.5, image, alpha=255).clamp_(0, 255)  # One copy: its pages cost most.
        return levels.to(torch.uint8).cpu().numpy()


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
    rgba: UInt8[Tensor, "*batch H W 4"] | Float[Tensor, "*batch H W 4"],
    image: Float[Tensor, "*batch H W 3"],
    background: Float[Tensor, "3"],
) -> Float[Tensor, "3 *batch H W 3"]:
    """Film over the image's background, image and shown error, each in [0, 1]."""
    film = composite(rgba_to_float(rgba, image.dtype), background)
    error = shown_error(image, film_over(rgba, background, image))
    return torch.stack([film, image, error]).clamp(0, 1)
