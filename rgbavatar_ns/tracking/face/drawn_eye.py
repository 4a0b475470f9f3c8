"""A plain drawing of an eye, with derivatives: skin, lids, sclera, iris, pupil and lashes.

Ours, because landmark networks look at eyes of a few pixels and Daugman's operator (1993), the edge
along a circle, wants the circle's top and bottom, which lids hide.
"""

import numpy as np
from jaxtyping import Float

PARAMETERS = 16
CENTER, LOG_RADIUS, OBLIQUE, UPPER_LID, LOWER_LID = slice(0, 2), 2, 3, slice(4, 6), slice(6, 8)
SKIN, SCLERA, IRIS, PUPIL, LASHES, RAMP = slice(8, 10), slice(10, 12), 12, 13, 14, 15
"""Where an eye's parameters stand: the iris's middle (eye widths, from the middle of the corners,
along them and across, down), the logarithm of its radius, width by height; how far below the line
of the corners each lid is and how it bends to a side; brightness of skin above and below, of the
sclera before and after the iris, of the iris; what is added in the pupil, along the upper lid, and
an eye width along everything (the light of one side, a reflection in glasses).
"""
SHAPE = slice(0, SKIN.start)

STEP, ACROSS, DOWN = 1 / 22, 26, 16
"""Samples of a patch: their distance in eye widths, and how many."""
ALONG, BELOW = (
    axis.reshape(1, -1) * STEP
    for axis in np.meshgrid(
        np.arange(ACROSS) - (ACROSS - 1) / 2, np.arange(DOWN) - (DOWN - 1) / 2, indexing="xy"
    )
)
"""Where samples lie in the eye [1, N], row by row."""
_OPENING = np.where(np.abs(ALONG) < 0.5, 1 - 4 * ALONG**2, 2 - 4 * np.abs(ALONG))
"""A lid's course, a parabola from corner to corner that goes on straight."""
_BENT = np.maximum(1 - 4 * ALONG**2, 0) * ALONG
# A pupil in a lit room is a third as wide as its iris or a little more; lashes darken a
# millimetre of the lid's edge; upper and lower skin go over into each other at the corners.
_PUPIL_SHARE, _LASHES, _SKIN_BLEND = 0.35, 0.045, 0.15
_LOWER = 0.5 * (1 + np.tanh(BELOW / (2 * _SKIN_BLEND)))
# One sclera's brightness goes over into the other's behind the iris.
_SCLERA_BLEND = 0.5
_NO_DISTANCE = 1e-6


def drawn_eye(
    parameters: Float[np.ndarray, "E 16"], soft: Float[np.ndarray, "E"]
) -> tuple[Float[np.ndarray, "E N"], Float[np.ndarray, "E 16 N"]]:
    """Brightness of every sample, and its derivatives to the parameters.

    `soft` is how far edges reach, in eye widths. The sclera's blend counts as fixed.
    """
    by_parameter = parameters.T[..., None]
    center_x, center_y, log_radius, oblique = by_parameter[:4]
    upper_height, upper_bend, lower_height, lower_bend = by_parameter[4:8]
    skin_above, skin_below, sclera_before, sclera_after = by_parameter[8:12]
    iris, pupil, lashes, ramp = by_parameter[12:]
    sharpness = 1 / soft[:, None]
    above = (BELOW - upper_height * _OPENING - upper_bend * _BENT) * sharpness
    under_upper = _step(above)
    over_lower = _step((lower_height * _OPENING + lower_bend * _BENT - BELOW) * sharpness)
    between = under_upper * over_lower

    radius = np.exp(log_radius)
    off_x, off_y = (ALONG - center_x) / oblique, BELOW - center_y
    distance = np.sqrt(off_x**2 + off_y**2 + _NO_DISTANCE)
    in_iris = _step((radius - distance) * sharpness)
    in_pupil = _step((_PUPIL_SHARE * radius - distance) * sharpness)
    after = _step((ALONG - center_x) / (_SCLERA_BLEND * radius))
    sclera = sclera_before + (sclera_after - sclera_before) * after
    eye = sclera + in_iris * (iris - sclera) + in_pupil * pupil
    skin = skin_above + (skin_below - skin_above) * _LOWER
    from_lid = above / (sharpness * _LASHES)
    lashed = np.exp(-0.5 * from_lid**2)
    brightness = skin + between * (eye - skin) + lashes * lashed + ramp * ALONG

    slopes = np.empty((len(parameters), PARAMETERS, ALONG.size), brightness.dtype)
    rim = between * (iris - sclera) * in_iris * (1 - in_iris) * sharpness
    inner_rim = between * pupil * in_pupil * (1 - in_pupil) * sharpness
    outwards = (rim + inner_rim) / distance
    slopes[:, 0] = outwards * off_x / oblique
    slopes[:, 1] = outwards * off_y
    slopes[:, LOG_RADIUS] = (rim + _PUPIL_SHARE * inner_rim) * radius
    slopes[:, OBLIQUE] = outwards * off_x**2 / oblique
    uncovered = (eye - skin) * between * sharpness
    by_upper = lashes * lashed * from_lid / _LASHES - uncovered * (1 - under_upper)
    by_lower = uncovered * (1 - over_lower)
    slopes[:, 4], slopes[:, 5] = by_upper * _OPENING, by_upper * _BENT
    slopes[:, 6], slopes[:, 7] = by_lower * _OPENING, by_lower * _BENT
    slopes[:, 8], slopes[:, 9] = (1 - between) * (1 - _LOWER), (1 - between) * _LOWER
    white = between * (1 - in_iris)
    slopes[:, 10], slopes[:, 11] = white * (1 - after), white * after
    slopes[:, IRIS], slopes[:, PUPIL] = between * in_iris, between * in_pupil
    slopes[:, LASHES] = lashed
    slopes[:, RAMP] = ALONG
    return brightness, slopes


def _step(away: Float[np.ndarray, "E N"]) -> Float[np.ndarray, "E N"]:
    """From 0 to 1, a half at 0."""
    return 0.5 * (1 + np.tanh(0.5 * away))
