"""How sharp a film is: no edge of a matte should be sharper."""

from math import erf, sqrt

import cv2
import numpy as np
from jaxtyping import Float, UInt8

# An edge is looked at over so many pixels, where these differ by so many levels: ten times a
# webcam's noise, and still found in a dark room.
_SPAN_PX, _CONTRAST_LEVELS = 9, 40.0
# So near the person, since captions and frames around pictures are none of the lens.
_AROUND_PX = 4
# The sharp quarter of the edges is the lens's doing, the rest are soft by themselves; so many are
# needed to tell.
_SHARP_PERCENT, _FEWEST = 75, 50
_WIDTHS_PX = np.linspace(0.2, 4.0, 381)
# The largest share of an edge's height between two neighbouring pixels, if it is a step blurred by
# each of these widths.
_STEEPEST = np.array([erf(1 / (2 * sqrt(2) * width)) for width in _WIDTHS_PX])


def edge_width_px(
    image_rgb: UInt8[np.ndarray, "S S 3"], matte: Float[np.ndarray, "S S"]
) -> float | None:
    """How wide the sharp edges of the person and of its outline are: one standard deviation of the
    blur of a step, pixels. None where too few are seen.

    Ours: the steepest slope between neighbours as a share of the levels around, along rows and
    columns. A drawn picture has .7, since its sharp edges lie slanted too.
    """
    grey = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    reach = np.ones((2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1), np.uint8)
    near = cv2.dilate((matte > 0.5).astype(np.uint8), reach) > 0
    shares = []
    for levels, here in ((grey, near), (np.ascontiguousarray(grey.T), near.T)):
        along = np.ones((1, _SPAN_PX), np.uint8)
        height = (cv2.dilate(levels, along) - cv2.erode(levels, along))[:, :-1]
        slope = np.abs(np.diff(levels, axis=1))
        peak = (slope >= cv2.dilate(slope, along)) & (height > _CONTRAST_LEVELS) & here[:, :-1]
        shares.append(slope[peak] / height[peak])
    found = np.concatenate(shares)
    if len(found) < _FEWEST:
        return None
    sharp = float(np.percentile(found, _SHARP_PERCENT))
    return float(np.interp(-sharp, -_STEEPEST, _WIDTHS_PX))
