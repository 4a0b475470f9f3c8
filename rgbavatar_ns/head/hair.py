"""Where hair grows."""

import numpy as np
from jaxtyping import Bool

from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.joints import EYES

_EAR_TOP_M, _HAIRLINE_M, _HAIRLINE_SLOPE, _BEHIND_EARS_M = 0.02, 0.043, 0.96, -0.095
"""From between the eyes: how high the ears' tops are, how high the hairline is there and how it
rises forwards, and what lies behind the ears."""
_NAPE_M = 0.06
"""How far below the eyes hair grows there: to the height of the upper lip."""


def haired_vertices(arrays: HeadArrays) -> Bool[np.ndarray, "V"]:
    """Where hair grows on most heads: above the forehead and the ears, and behind the ears.

    In a head's own measure from between its eyes, so that it holds for any head model.
    """
    template = arrays.v_template.astype(np.float64)
    eyes = (arrays.joint_regressor[EYES].astype(np.float64) @ template).mean(0)
    _, above, ahead = (template - eyes).T
    line_m = np.maximum(_EAR_TOP_M, _HAIRLINE_M + _HAIRLINE_SLOPE * ahead)
    return (above > line_m) | ((ahead < _BEHIND_EARS_M) & (above > -_NAPE_M))
