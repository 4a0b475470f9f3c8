"""A picture of an avatar as it would be without holes and noise."""

from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

_WIDTH = 256
"""Pictures twice as wide or more are smoothed at about this width: blurs leave no more detail."""
_LIGHT_PX, _HUE_PX = 1.0, 3.0
"""Standard deviations of the blurs in a picture so wide: eyes see noise of hue first, and skin and
hair have less of it than of light."""
_FAR = 0.1
"""Weight of the wider surroundings, which fill what is nearly empty."""
_LEAST = 1e-3
"""Smallest alpha that colours are divided by."""
_MEAN_AND_ALPHA = np.array([[1 / 3, 1 / 3, 1 / 3, 0], [0, 0, 0, 1]], np.float32)


def closed(
    image: Float[np.ndarray, "rows columns 4"], width: int
) -> UInt8[np.ndarray, "rows columns 4"]:
    """Smooth a part of a picture of this width, in hue more than in light, and make it opaque.

    RGBA with premultiplied colours; the result is straight. Blurs leave out what is not there: a
    hole takes the colour of its surroundings. Ours, because a picture's own blur needs no truth,
    and leaves alone what is smooth already. By OpenCV, which takes a tenth of torch's time.
    """
    size, times = image.shape[:2], _times_smaller(width)
    image = _shrunk(image.astype(np.float32, copy=False), times)
    small, scale = image.shape[:2], width / times / _WIDTH
    far = _blurred(_shrunk(image, 2), _HUE_PX * scale / 2)
    near = _blurred(cv2.transform(image, _MEAN_AND_ALPHA), _LIGHT_PX * scale)
    colors = far[..., :3] / np.maximum(far[..., 3:], _LEAST)
    hue = colors - colors.mean(-1, keepdims=True)
    wider = cv2.resize(cv2.transform(far, _MEAN_AND_ALPHA), small[::-1])
    wider = cv2.addWeighted(near, 1, wider, _FAR, 0)
    plain = cv2.resize(hue, small[::-1]) + wider[..., :1] / np.maximum(wider[..., 1:], _LEAST)
    plain = cv2.resize(cv2.convertScaleAbs(np.maximum(plain, 0), alpha=255), size[::-1])
    return np.dstack([plain, np.full(size, 255, np.uint8)])


def closed_on_device(
    image: Float[Tensor, "rows columns 4"], width: int
) -> UInt8[Tensor, "rows columns 4"]:
    """As `closed`, to a count of 255, where the picture lies on a device that is not to wait.

    All that is done to pictures is done to their rows and to their columns, by a matrix each.
    """
    (rows, columns), times = image.shape[:2], _times_smaller(width)
    scale = width / times / _WIDTH
    image = _along("shrunk", image.permute(2, 0, 1), times, times)
    far = _along("blurred", _along("shrunk", image, 2, 2), *[_HUE_PX * scale / 2] * 2)
    near = _along("blurred", _mean_and_alpha(image), *[_LIGHT_PX * scale] * 2)
    colors = far[:3] / far[3:].clamp(min=_LEAST)
    hue = _along("grown", colors - colors.mean(0), *image.shape[1:])
    wider = near + _FAR * _along("grown", _mean_and_alpha(far), *image.shape[1:])
    plain = hue + wider[:1] / wider[1:].clamp(min=_LEAST)
    plain = _along("grown", (255 * plain).clamp(0, 255).round(), rows, columns).round()
    opaque = torch.full_like(plain[:1], 255)
    return torch.cat([plain, opaque]).permute(1, 2, 0).to(torch.uint8)


def with_light_of(
    own: Float[Tensor, "rows columns 4"],
    plain: UInt8[Tensor, "rows columns 4"],
    share: Float[Tensor, "rows columns"],
) -> UInt8[Tensor, "rows columns 4"]:
    """A smoothed picture with so much of the light of its own, which is premultiplied, where that
    is opaque: in hair light is no noise, and its hue is."""
    light = 255 * own[..., :3].mean(-1, keepdim=True) / own[..., 3:].clamp(min=_LEAST)
    color = plain[..., :3].to(own)
    share = share[..., None] * own[..., 3:]
    lit = (color + share * (light - color.mean(-1, keepdim=True))).clamp(0, 255).round()
    return torch.cat([lit.to(torch.uint8), plain[..., 3:]], -1)


def _times_smaller(width: int) -> int:
    return max(1, width // _WIDTH)


def _mean_and_alpha(image: Float[Tensor, "4 rows columns"]) -> Float[Tensor, "2 rows columns"]:
    return torch.stack([image[:3].mean(0), image[3]])


def _along(
    change: Literal["shrunk", "blurred", "grown"],
    image: Float[Tensor, "C height width"],
    of_rows: int | float,
    of_columns: int | float,
) -> Float[Tensor, "C rows columns"]:
    """Change rows and columns: so many times fewer, blurred by so many pixels, to a number."""
    height, width = image.shape[1:]
    rows = _matrix(change, height, of_rows, image.device)
    return rows @ image @ _matrix(change, width, of_columns, image.device).T


@lru_cache(maxsize=512)
def _matrix(
    change: str, size: int, by: int | float, device: torch.device
) -> Float[Tensor, "changed size"]:
    """What OpenCV makes of the rows of the unit matrix."""
    unit = np.eye(size, dtype=np.float32)
    if change == "blurred":
        kernel = cv2.getGaussianKernel(2 * round(4 * by) + 1, by)  # as large as OpenCV's own
        changed = cv2.sepFilter2D(unit, -1, np.ones(1), kernel, borderType=cv2.BORDER_REPLICATE)
    elif change == "shrunk":
        changed = cv2.resize(unit, (size, -(-size // int(by))), interpolation=cv2.INTER_AREA)
    else:
        changed = cv2.resize(unit, (size, int(by)))
    return torch.from_numpy(changed).to(device)


def _shrunk(
    image: Float[np.ndarray, "height width 4"], times: int
) -> Float[np.ndarray, "rows columns 4"]:
    """So many times smaller, by means."""
    if times == 1:
        return image
    rows, columns = (-(-side // times) for side in image.shape[:2])
    return cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)


def _blurred(
    image: Float[np.ndarray, "height width C"], sigma_px: float
) -> Float[np.ndarray, "height width C"]:
    return cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
