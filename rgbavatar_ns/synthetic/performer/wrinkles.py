"""Wrinkles that come with expressions: where, how deep, and when."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.synthetic.performer.noise import value_noise
from rgbavatar_ns.synthetic.performer.regions import EYE_CENTRE_M, Points, bump, smooth

WRINKLES = ("forehead", "crows_feet", "nasolabial", "glabella", "nose", "chin")
"""The groups of wrinkles; each comes and goes as one."""

_DRIVERS: dict[str, dict[str, float]] = {
    "forehead": {"browInnerUp": 0.7, "browOuterUp*": 0.4},
    "crows_feet": {"mouthSmile*": 0.3, "cheekSquint*": 0.5},
    "nasolabial": {"mouthSmile*": 0.5, "noseSneer*": 0.25},
    "glabella": {"browDown*": 0.6},
    "nose": {"noseSneer*": 0.6},
    "chin": {"mouthShrugLower": 0.7, "mouthFrown*": 0.3},
}
"""What folds them, by how much; "*" stands for both sides."""


def wrinkle_activations(
    expression: Float[np.ndarray, "F E"], names: Sequence[str]
) -> Float[np.ndarray, "F W"]:
    """How far each group of wrinkles is folded, in [0, 1]; nothing below a slight expression.

    Not linear in the coefficients: skin resists at first, then folds, then can fold no more.
    """
    columns = []
    for group in WRINKLES:
        weights = np.zeros(len(names))
        for name, weight in _DRIVERS[group].items():
            for side in ("Left", "Right") if name.endswith("*") else ("",):
                weights[list(names).index(name.removesuffix("*") + side)] = weight
        columns.append(smooth(expression @ weights, 0.15, 0.85))
    return np.stack(columns, -1)


def wrinkle_depths(p: Points) -> Float[np.ndarray, "N W"]:
    """Height of the fully folded skin over its rest in units of its greatest depth (negative:
    valley), at points of the template head.
    """
    shapes = (_forehead, _crows_feet, _nasolabial, _glabella, _nose, _chin)
    return np.stack([shape(p) for shape in shapes], 1).astype(np.float32)


def _valleys(phase: np.ndarray) -> np.ndarray:
    """Narrow valleys at whole numbers, low rolls between them."""
    wave = np.abs((phase + 0.5) % 1 - 0.5)
    return 0.35 - 1.35 * np.exp(-((wave / 0.16) ** 2))


def _front(p: Points) -> np.ndarray:
    return smooth(p[:, 2], 0.0, 0.02)


def _forehead(p: Points) -> np.ndarray:
    sway = 0.0022 * np.cos(p[:, 0] / 0.012) + 0.0012 * value_noise(p * 60, 11)
    phase = (p[:, 1] + sway - 0.0605) / 0.0088
    within = smooth(p[:, 1], 0.052, 0.060) * smooth(p[:, 1], 0.090, 0.082)
    return _valleys(phase) * within * smooth(np.abs(p[:, 0]), 0.050, 0.034) * _front(p)


def _crows_feet(p: Points) -> np.ndarray:
    outer = EYE_CENTRE_M[:2] + np.array([0.0135, -0.001])
    dx, dy = np.abs(p[:, 0]) - outer[0], p[:, 1] - outer[1]
    distance, angle = np.hypot(dx, dy), np.arctan2(dy, np.maximum(dx, 1e-6))
    fan = smooth(distance, 0.002, 0.006) * smooth(distance, 0.022, 0.012)
    return _valleys(angle / 0.42) * fan * smooth(np.abs(angle), 1.15, 0.85) * (dx > 0)


def _nasolabial(p: Points) -> np.ndarray:
    x = np.abs(p[:, 0])
    fold = np.interp(
        p[:, 1],
        [-0.052, -0.040, -0.028, -0.016, -0.006, 0.002],
        [0.0330, 0.0325, 0.0295, 0.0250, 0.0200, 0.0175],
    )
    within = smooth(p[:, 1], -0.053, -0.040) * smooth(p[:, 1], 0.003, -0.006)
    side = x - fold
    shape = 0.9 * bump(side, 0.0062, 0.0032) - 1.0 * bump(side, 0.0, 0.0017)
    return shape * within * _front(p)


def _glabella(p: Points) -> np.ndarray:
    x = np.abs(p[:, 0] + 0.0008)
    lines = bump(x, 0.0062 + 0.10 * (p[:, 1] - 0.045), 0.0012)
    roll = bump(x, 0.0, 0.0030) + bump(x, 0.0115, 0.0030)
    within = smooth(p[:, 1], 0.033, 0.040) * smooth(p[:, 1], 0.064, 0.052)
    return (0.5 * roll - 1.2 * lines) * within * _front(p)


def _nose(p: Points) -> np.ndarray:
    phase = (p[:, 1] - 0.8 * np.abs(p[:, 0]) - 0.016) / 0.0055
    within = smooth(p[:, 1], 0.010, 0.016) * smooth(p[:, 1], 0.040, 0.031)
    return _valleys(phase) * within * smooth(np.abs(p[:, 0]), 0.015, 0.008) * _front(p)


def _chin(p: Points) -> np.ndarray:
    spots = value_noise(p * 260, 23)
    within = bump(p[:, 0], 0, 0.011) * bump(p[:, 1], -0.066, 0.008) * _front(p)
    return np.clip(spots * 1.6 - 0.2, -1, 0.6) * within
