"""Pictures of one size in rows, with labels: uint8 arrays as OpenCV draws into them."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from rgbavatar_ns.drawing.compositing import composite_bytes, unfilmed_pixels

_GRAY = 128 / 255
_HATCH, _HATCH_TILES = 80, 24
_LABEL_SCALE = 1 / 640


def contact_sheet(
    tiles: Sequence[UInt8[np.ndarray, "h w C"]], columns: int, blank: int = 0
) -> UInt8[np.ndarray, "H W C"]:
    """Put pictures beside one another, at most `columns` a row; `blank` fills the last row."""
    columns = min(columns, len(tiles))
    filled = [*tiles, *[np.full_like(tiles[0], blank)] * (-len(tiles) % columns)]
    rows = [np.hstack(filled[start : start + columns]) for start in range(0, len(tiles), columns)]
    return np.vstack(rows)


def labelled(picture: UInt8[np.ndarray, "h w C"], text: str) -> UInt8[np.ndarray, "h w C"]:
    """A copy with white text, outlined in black, in its upper left corner; opaque in RGBA."""
    written = picture.copy()
    size = picture.shape[0] * _LABEL_SCALE
    place = (round(12 * size), round(36 * size))
    for color, width in (((0, 0, 0, 255), 3), ((255, 255, 255, 255), 1)):
        cv2.putText(written, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, width, cv2.LINE_AA)
    return written


def scaled(picture: UInt8[np.ndarray, "h w C"], zoom: float) -> UInt8[np.ndarray, "H W C"]:
    """The picture `zoom` times as large, at least one pixel wide and high."""
    width, height = (max(1, round(side * zoom)) for side in picture.shape[1::-1])
    method = cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, (width, height), interpolation=method))


def over_gray_bgr(
    image_rgba: UInt8[np.ndarray, "h w 4"], zoom: float
) -> UInt8[np.ndarray, "H W 3"]:
    """A matted picture over grey, `zoom` times as large, blue first; hatched where unfilmed."""
    rgb = composite_bytes(image_rgba, (_GRAY, _GRAY, _GRAY))
    height, width = rgb.shape[:2]
    diagonal = np.add.outer(np.arange(height), np.arange(width)) * _HATCH_TILES
    stripes = diagonal // max(height, width) % 2 == 0
    rgb[stripes & unfilmed_pixels(image_rgba)] = _HATCH
    return scaled(np.ascontiguousarray(rgb[..., ::-1]), zoom)
