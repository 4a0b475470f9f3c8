"""How the body's clothes look, coarsely: where they look otherwise, something is before them."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

_Image = UInt8[np.ndarray, "h w 3"]

# Colours are those of cells, shares of the picture's longer side, and may be found again within so
# many cells: stripes move on by some pixels before it is known how the body has moved.
_CELL_SHARE, _AROUND_CELLS = 1 / 80, 2
# Levels of 255 by which a cell looks otherwise; folds and the head's shadow change less.
_OTHERWISE_LEVELS = 32.0
_LEAST_PLACES = 12


@dataclass(frozen=True)
class ClothColors:
    """Colours that places of the body, as it was in a run's first frame, have where it is seen."""

    places_m: Float[np.ndarray, "P 3"]
    rgb: Float[np.ndarray, "P 3"]

    @classmethod
    def of(
        cls,
        image_rgb: _Image,
        places_m: Float[np.ndarray, "P 3"],
        places_px: Float[np.ndarray, "P 2"],
    ) -> "ClothColors":
        """The colours at pixels of a picture."""
        return cls(places_m, _sampled(_cells(image_rgb), image_rgb, places_px))

    def covered(
        self, image_rgb: _Image, places_px: Float[np.ndarray, "P 2"]
    ) -> tuple[Bool[np.ndarray, "P"], float]:
        """Which places look otherwise now, and their share of those within the picture.

        The share is NaN where too few are within it. Light that changes all alike is no change.
        """
        within = _within(image_rgb, places_px)
        if within.sum() < _LEAST_PLACES:
            return np.zeros(len(within), bool), np.nan
        cells = _cells(image_rgb)
        light = np.median((_sampled(cells, image_rgb, places_px) - self.rgb)[within], axis=0)
        around = np.ones((2 * _AROUND_CELLS + 1,) * 2, np.uint8)
        lowest, highest = (
            _sampled(part, image_rgb, places_px) - light
            for part in (cv2.erode(cells, around), cv2.dilate(cells, around))
        )
        change = np.maximum(lowest - self.rgb, self.rgb - highest).max(1)
        otherwise = within & (change > _OTHERWISE_LEVELS)
        return otherwise, float(otherwise.sum() / within.sum())

    def renewed(self, image_rgb: _Image, places_px: Float[np.ndarray, "P 2"]) -> "ClothColors":
        """With the colours of now, within the picture: light moves on through a film."""
        now = _sampled(_cells(image_rgb), image_rgb, places_px)
        within = _within(image_rgb, places_px)[:, None]
        return ClothColors(self.places_m, np.where(within, now, self.rgb))


def _within(image_rgb: _Image, px: Float[np.ndarray, "P 2"]) -> Bool[np.ndarray, "P"]:
    height, width = image_rgb.shape[:2]
    x, y = px.T
    return (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)


def _cells(image_rgb: _Image) -> Float[np.ndarray, "r c 3"]:
    height, width = image_rgb.shape[:2]
    cell = max(1, round(_CELL_SHARE * max(height, width)))
    size = (max(1, width // cell), max(1, height // cell))
    return cv2.resize(image_rgb, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _sampled(
    cells: Float[np.ndarray, "r c 3"], image_rgb: _Image, px: Float[np.ndarray, "P 2"]
) -> Float[np.ndarray, "P 3"]:
    """Cells about pixels, whose centres lie at whole numbers; beyond the edge the edge's."""
    if not len(px):
        return np.zeros((0, 3))
    rows, columns = cells.shape[:2]
    height, width = image_rgb.shape[:2]
    at = (px + 0.5) * (columns / width, rows / height) - 0.5
    x, y = at.astype(np.float32).T
    found = cv2.remap(cells, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(-1, 3).astype(np.float64)
