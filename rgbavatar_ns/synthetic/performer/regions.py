"""Where things are on the embedded head, in the coordinates of its template (metres).

Every function takes points on the template head [N, 3] and returns a value in [0, 1] or a height;
the numbers are places on MakeHuman's average face, read off once.
"""

import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "N 3"]
Values = Float[np.ndarray, "N"]
Level = float | int | np.ndarray

EYE_CENTRE_M = np.array([0.0289, 0.0300, 0.0300])
"""Of the left eyeball; the right one is its mirror image."""
MOUTH_CORNER_M = np.array([0.0225, -0.0377])

# Hairline on the head's side, as heights y over depths z.
_HAIR_Z = (-0.14, -0.085, -0.066, -0.06, -0.03, -0.024, -0.012, -0.004, 0.018, 0.032, 0.052, 0.08)
_HAIR_Y = (-0.05, -0.048, -0.02, 0.043, 0.043, -0.004, 0, 0.036, 0.06, 0.076, 0.09, 0.094)


def smooth(value: np.ndarray, start: Level, end: Level) -> np.ndarray:
    """Smoothstep from 0 at `start` to 1 at `end`; `end` may be the smaller one."""
    t = np.clip((value - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def bump(value: np.ndarray, centre: Level, width: float) -> np.ndarray:
    """A Gaussian bell of height 1."""
    return np.exp(-0.5 * ((value - centre) / width) ** 2)


def above_hairline_m(p: Points) -> Values:
    """Height above the hairline in metres, negative below it."""
    return p[:, 1] - np.interp(p[:, 2], _HAIR_Z, _HAIR_Y)


def lips(p: Points) -> Values:
    """Both lips, the part that rolls inwards included."""
    x = np.abs(p[:, 0]) / MOUTH_CORNER_M[0]
    arch = np.sqrt(np.clip(1 - x**2, 0, 1))
    upper = MOUTH_CORNER_M[1] + 0.0052 * arch**1.2 + 0.0010 * bump(x, 0.24, 0.14)
    lower = MOUTH_CORNER_M[1] - 0.0085 * arch**1.3
    inside = smooth(p[:, 1], lower - 0.0006, lower + 0.0006)
    inside = inside * smooth(p[:, 1], upper + 0.0006, upper - 0.0006)
    return inside * smooth(x, 1.04, 0.96) * smooth(p[:, 2], 0.030, 0.036)


def brows(p: Points) -> Values:
    """Both eyebrows, dense in the middle."""
    x = np.abs(p[:, 0])
    centre = np.interp(x, [0.010, 0.022, 0.036, 0.050], [0.0415, 0.0455, 0.0478, 0.0420])
    half = np.interp(x, [0.010, 0.018, 0.034, 0.051], [0.0030, 0.0040, 0.0030, 0.0010])
    along = smooth(x, 0.0085, 0.0125) * smooth(x, 0.0520, 0.0470)
    across = smooth(np.abs(p[:, 1] - centre), half * 1.0 + 0.0012, half * 0.35)
    return along * across * smooth(p[:, 2], 0.0, 0.01)


def stubble(p: Points) -> Values:
    """Where a beard would grow: jaw, chin and upper lip."""
    x = np.abs(p[:, 0])
    jaw = smooth(p[:, 1] + 0.28 * x, -0.028, -0.046) * smooth(p[:, 1], -0.112, -0.088)
    jaw = np.maximum(jaw, smooth(p[:, 2], 0.012, -0.012) * bump(p[:, 1], -0.03, 0.02))
    moustache = smooth(x, 0.030, 0.021) * bump(p[:, 1], -0.026, 0.0055)
    return np.maximum(jaw, moustache) * smooth(p[:, 2], -0.030, -0.012) * (1 - lips(p))


def cheeks(p: Points) -> Values:
    """The apples of both cheeks."""
    middle = bump(np.abs(p[:, 0]), 0.040, 0.014) * bump(p[:, 1], -0.004, 0.014)
    return middle * smooth(p[:, 2], 0, 0.02)


def shirt(p: Points) -> Values:
    """What a round collar covers."""
    collar = -0.128 - 0.030 * bump(p[:, 0], 0, 0.05) * smooth(p[:, 2], -0.08, 0.0)
    return smooth(p[:, 1], collar + 0.0008, collar - 0.0008)


def near_lid_edge(p: Points, eye_radius_m: float) -> Values:
    """Skin that touches an eyeball: the lashes' line."""
    side = np.stack([np.abs(p[:, 0]), p[:, 1], p[:, 2]], 1)
    gap = np.linalg.norm(side - EYE_CENTRE_M, axis=1) - eye_radius_m
    return smooth(gap, 0.0016, 0.0006) * smooth(p[:, 2], 0.030, 0.034)
