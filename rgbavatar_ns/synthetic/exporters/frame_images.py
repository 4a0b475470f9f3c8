"""Pictures as the formats keep them."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from rgbavatar_ns.data.png import encode_png_rgba

_JPEG_QUALITY = 98


def write_rgba(path: Path, image_rgba: UInt8[np.ndarray, "height width 4"]) -> None:
    """A PNG with straight alpha."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png_rgba(image_rgba))


def write_color(path: Path, image_rgba: UInt8[np.ndarray, "height width 4"]) -> None:
    """Colour without alpha; PNG or JPEG after the name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bgr = cv2.cvtColor(image_rgba, cv2.COLOR_RGBA2BGR)
    cv2.imwrite(str(path), bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def write_grey(path: Path, grey: UInt8[np.ndarray, "height width"]) -> None:
    """A mask; PNG or JPEG after the name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), grey, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
