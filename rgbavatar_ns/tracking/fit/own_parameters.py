"""Bounds and priors for expressions that have a number for a name, as FLAME's have."""

import re
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.tracking.fit.parameters import FitParameters

_NUMBERED = re.compile(r"expression_\d+")
# Directions found by statistics go both ways and have a standard deviation of 1. The first hold
# nearly all that landmarks see; each more costs time.
_FITTED_DIRECTIONS = 50
_BOUND = 3.0
_PRIOR_M, _PRIOR_LEAST, _PRIOR_MOST = 0.005, 0.15, 1.0
_FRAME_M, _FRAME_LEAST, _FRAME_MOST = 0.001, 0.03, 0.3


def with_signed_expressions(
    parameters: FitParameters,
    layout: ThetaLayout,
    expression_names: tuple[str, ...],
    expression_size_m: Float[np.ndarray, "E"],
) -> FitParameters:
    """The same, but numbered expressions go both ways, and only the first 50 of them are fitted.

    Prior and temporal widths are a standard deviation of 1 and what moves a landmark by 1 mm from
    frame to frame, where directions are FLAME's; stronger directions get narrower ones.
    """
    if not all(_NUMBERED.fullmatch(name) for name in expression_names):
        return parameters
    part = layout.slice("expression")
    number = parameters.columns - part.start
    is_expression = (number >= 0) & (parameters.columns < part.stop)
    kept = ~is_expression | (number < _FITTED_DIRECTIONS)
    own = is_expression[kept]
    size_m = np.maximum(expression_size_m[number[kept & is_expression]], 1e-6)
    values = {
        name: getattr(parameters, name)[kept].copy()
        for name in ("lower", "upper", "prior_width", "temporal_width")
    }
    values["lower"][own], values["upper"][own] = -_BOUND, _BOUND
    values["prior_width"][own] = np.minimum(_PRIOR_M / size_m + _PRIOR_LEAST, _PRIOR_MOST)
    values["temporal_width"][own] = np.minimum(_FRAME_M / size_m + _FRAME_LEAST, _FRAME_MOST)
    return replace(parameters, columns=parameters.columns[kept], **values)
