"""Which parts of theta the tracker fits, within which bounds, and how they are drawn."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.head import ThetaLayout

# Jaw opening to 26 degrees; gaze to 30 degrees; the head to a little beyond profile.
_JAW_OPEN = (-0.02, 0.45)
_GAZE = (-0.55, 0.55)
_EXPRESSION = (0.0, 1.0)


@dataclass(frozen=True)
class FitParameters:
    """The fitted entries of theta (`columns`), with bounds, prior width and temporal width.

    Widths are standard deviations in the entry's unit; inf means free.
    """

    columns: Int[np.ndarray, "P"]
    lower: Float[np.ndarray, "P"]
    upper: Float[np.ndarray, "P"]
    prior_width: Float[np.ndarray, "P"]
    temporal_width: Float[np.ndarray, "P"]


def fit_parameters(
    layout: ThetaLayout,
    expression_names: tuple[str, ...],
    expression_size_m: Float[np.ndarray, "E"],
) -> FitParameters:
    """Rotation, translation, jaw opening, gaze and every expression that moves a landmark.

    `expression_size_m` is each expression's largest landmark motion; those below .2 mm (a jaw or
    gaze that is a joint in this head) are left at 0. Neck, jaw's other angles and the eyes' roll
    stay 0: landmarks of the face alone cannot tell them from the rest.
    """
    rows: list[tuple[int, float, float, float, float]] = []
    for column in _columns(layout, "rotation"):
        rows.append((column, -2.0, 2.0, np.inf, 0.02))
    for column in _columns(layout, "translation"):
        rows.append((column, -10.0, 10.0, np.inf, 0.004))
    rows.append((layout.slice("jaw").start, *_JAW_OPEN, 0.3, 0.1))
    for name in ("left_eye", "right_eye"):
        first = layout.slice(name).start
        rows += [(first, *_GAZE, 0.25, 0.08), (first + 1, *_GAZE, 0.25, 0.08)]
    first = layout.slice("expression").start
    for number, name in enumerate(expression_names):
        if expression_size_m[number] < 2e-4 or name.startswith("eyeLook"):
            continue
        quick = name.startswith("eyeBlink")
        # Small motions are hardly seen and would wander: the prior is in millimetres moved.
        width = 1.0 if quick else min(0.5, 0.002 / expression_size_m[number] + 0.15)
        rows.append((first + number, *_EXPRESSION, width, 0.6 if quick else 0.12))
    if "eyelids" in layout:
        rows += [(column, 0.0, 1.0, 1.0, 0.6) for column in _columns(layout, "eyelids")]
    columns, lower, upper, prior, temporal = (np.array(part) for part in zip(*rows))
    return FitParameters(columns.astype(np.int64), lower, upper, prior, temporal)


def _columns(layout: ThetaLayout, name: str) -> range:
    part = layout.slice(name)
    return range(part.start, part.stop)
