"""A picture of an avatar as it would be without holes and noise."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

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
    size, times = image.shape[:2], max(1, width // _WIDTH)
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
