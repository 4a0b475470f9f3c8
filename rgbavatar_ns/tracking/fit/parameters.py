"""Which parts of theta the tracker fits, within which bounds, and how they are drawn."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.head.arrays import NECK_SHIFTS

# Jaw opening to 26 degrees; the head to a little beyond profile.
_JAW_OPEN = (-0.02, 0.45)
# Eyes turn by 45 to 50 degrees at most, but beyond some 20 the head comes along (Stahl 1999), and
# beyond 30 lids and lashes hide an iris from FaceMesh. Up and down they go less far, and there
# FaceMesh's irises tell little: they follow by 40 % on renders, by 10 to 40 % on photographs whose
# irises were moved by hand. Undoing that makes errors as many times larger, so that without a
# narrow prior a person's lids of another shape look like a gaze of 10 to 30 degrees.
GAZE_BOUNDS_RAD = (-0.55, 0.55)
_GAZE_PITCH_WIDTH, _GAZE_YAW_WIDTH, _GAZE_STEP = 0.1, 0.2, 0.08
# Both eyes move as one (Hering's law); their height is the same. They meet on what is looked at:
# 63 mm apart they turn towards each other by 6 degrees at .6 m and by 1 at 3 m; 2.3 are in between.
# Pictures tell little of it: half a millimetre in the eyes' places on the head are 2 degrees.
_SAME_PITCH_WIDTH, _VERGENCE, _VERGENCE_WIDTH = 0.02, 0.04, 0.02
_EXPRESSION = (0.0, 1.0)
_EXPRESSION_WIDTH, _BLINK_WIDTH = 0.4, 1.0
# Expressions that have a number for a name, as FLAME's have, were found by statistics: they go
# both ways and have a standard deviation of 1. The first hold nearly all that landmarks see; each
# more costs time. Widths are 1 and what moves a landmark by 1 mm from frame to frame, where
# directions are FLAME's; stronger directions get narrower ones.
_NUMBERED = re.compile(r"expression_\d+")
_FITTED_DIRECTIONS, _DIRECTION_BOUND = 50, 3.0
_PRIOR_M, _PRIOR_LEAST, _PRIOR_MOST = 0.005, 0.15, 1.0
_FRAME_M, _FRAME_LEAST, _FRAME_MOST = 0.001, 0.03, 0.3
# Landmarks hardly see some expressions (cheeks, lower lids), but muscles seldom act alone: both
# sides of a face mostly do the same, and what is done by one muscle, or in one act such as a
# smile, goes together. Muscles and their partners: Facial Action Coding System (Ekman and Friesen
# 1978), whose action units stand beside. How closely is ours, from renders of procedural people.
_SIDES_WIDTH, _PARTNERS_WIDTH = 0.25, 0.4
_PARTNERS = (
    ("browInnerUp", "browOuterUp"),  # 1, 2: frontalis
    ("browOuterUp", "eyeWide"),  # 2, 5: surprise
    ("browDown", "eyeSquint"),  # 4, 7: a frown against light
    ("cheekSquint", "eyeSquint"),  # 6, 7: orbicularis oculi
    ("cheekSquint", "mouthSmile"),  # 6, 12: Duchenne's smile
    ("mouthUpperUp", "noseSneer"),  # 10, 9: levator labii superioris
    ("mouthFrown", "mouthShrugLower"),  # 15, 17: sadness
    ("mouthFunnel", "mouthPucker"),  # 22, 18: rounded lips
    ("mouthRollLower", "mouthPress"),  # 28, 24: orbicularis oris
    ("mouthRollLower", "mouthRollUpper"),  # 28: both lips
)


@dataclass(frozen=True)
class FitParameters:
    """The fitted entries of theta (`columns`), with bounds, prior width and temporal width.

    Widths are standard deviations in the entry's unit; inf means free. `ties` are pairs of columns
    whose difference has a prior too, around `tie_mean` with the width `tie_width`.
    """

    columns: Int[np.ndarray, "P"]
    lower: Float[np.ndarray, "P"]
    upper: Float[np.ndarray, "P"]
    prior_width: Float[np.ndarray, "P"]
    temporal_width: Float[np.ndarray, "P"]
    ties: Int[np.ndarray, "T 2"]
    tie_mean: Float[np.ndarray, "T"]
    tie_width: Float[np.ndarray, "T"]

    def prior_precision(self) -> Float[np.ndarray, "P P"]:
        """Inverse covariance of the prior."""
        apart = self._tied() / self.tie_width[:, None]
        return np.diag(self.prior_width**-2.0) + apart.T @ apart

    def prior_pull(self) -> Float[np.ndarray, "P"]:
        """The prior's precision times its mean, which is 0 but for the ties' sake."""
        return (self.tie_mean / self.tie_width**2) @ self._tied()

    def _tied(self) -> Float[np.ndarray, "T P"]:
        """A tie's difference from the entries."""
        place = {int(column): number for number, column in enumerate(self.columns)}
        apart = np.zeros((len(self.ties), len(self.columns)))
        for row, tie in zip(apart, self.ties):
            row[[place[int(column)] for column in tie]] = 1.0, -1.0
        return apart


def fit_parameters(
    layout: ThetaLayout,
    expression_names: tuple[str, ...],
    expression_size_m: Float[np.ndarray, "E"],
) -> FitParameters:
    """Rotation, translation, jaw opening, gaze and every expression that moves a landmark.

    `expression_size_m` is each expression's largest landmark motion; those below .2 mm (a jaw or
    gaze that is a joint in this head) are left at 0, and numbered ones after the first 50. Neck,
    jaw's other angles and the eyes' roll stay 0: landmarks of the face alone cannot tell them from
    the rest.
    """
    rows: list[tuple[int, float, float, float, float]] = []
    for column in _columns(layout, "rotation"):
        rows.append((column, -2.0, 2.0, np.inf, 0.02))
    for column in _columns(layout, "translation"):
        rows.append((column, -10.0, 10.0, np.inf, 0.004))
    rows.append((layout.slice("jaw").start, *_JAW_OPEN, 0.3, 0.1))
    for name in ("left_eye", "right_eye"):
        first = layout.slice(name).start
        for angle, width in enumerate((_GAZE_PITCH_WIDTH, _GAZE_YAW_WIDTH)):
            rows.append((first + angle, *GAZE_BOUNDS_RAD, width, _GAZE_STEP))
    first = layout.slice("expression").start
    numbered = all(_NUMBERED.fullmatch(name) for name in expression_names)
    for number, (name, size_m) in enumerate(zip(expression_names, expression_size_m.tolist())):
        if size_m < 2e-4 or name.startswith("eyeLook") or name in NECK_SHIFTS:
            continue
        if not numbered:
            quick = name.startswith("eyeBlink")
            width = _BLINK_WIDTH if quick else _EXPRESSION_WIDTH
            rows.append((first + number, *_EXPRESSION, width, 0.6 if quick else 0.12))
        elif number < _FITTED_DIRECTIONS:
            prior = min(_PRIOR_M / size_m + _PRIOR_LEAST, _PRIOR_MOST)
            step = min(_FRAME_M / size_m + _FRAME_LEAST, _FRAME_MOST)
            rows.append((first + number, -_DIRECTION_BOUND, _DIRECTION_BOUND, prior, step))
    if "eyelids" in layout:
        rows += [(column, 0.0, 1.0, 1.0, 0.6) for column in _columns(layout, "eyelids")]
    columns, lower, upper, prior, temporal = (np.array(part) for part in zip(*rows))
    fitted = {name: first + number for number, name in enumerate(expression_names)}
    fitted = {name: column for name, column in fitted.items() if column in set(columns.tolist())}
    ties = _ties(layout, fitted)
    return FitParameters(columns.astype(np.int64), lower, upper, prior, temporal, *ties)


def _ties(
    layout: ThetaLayout, fitted: Mapping[str, int]
) -> tuple[Int[np.ndarray, "T 2"], Float[np.ndarray, "T"], Float[np.ndarray, "T"]]:
    """Pairs of columns with their differences' means and widths; expressions' columns by name.

    Of eyes, then of the sides of the face and of partners.
    """
    found: dict[tuple[str, str], float] = {}
    for name in fitted:
        other = name.removesuffix("Left") + "Right"
        # The jaw and the whole mouth go to one side or the other.
        if name.endswith("Left") and name not in ("jawLeft", "mouthLeft"):
            found[name, other] = _SIDES_WIDTH
    for pair in _PARTNERS:
        for side in ("Left", "Right"):
            first, second = (name if name in fitted else name + side for name in pair)
            found[first, second] = _PARTNERS_WIDTH
    known = {pair: width for pair, width in found.items() if set(pair) <= set(fitted)}
    left, right = (layout.slice(name).start for name in ("left_eye", "right_eye"))
    ties = [(left, right), (left + 1, right + 1)]
    ties += [(fitted[first], fitted[second]) for first, second in known]
    means, widths = np.zeros(len(ties)), [_SAME_PITCH_WIDTH, _VERGENCE_WIDTH, *known.values()]
    means[1] = -_VERGENCE  # towards the nose: the left eye to its right
    return np.array(ties, np.int64), means, np.array(widths, np.float64)


def _columns(layout: ThetaLayout, name: str) -> range:
    part = layout.slice(name)
    return range(part.start, part.stop)
