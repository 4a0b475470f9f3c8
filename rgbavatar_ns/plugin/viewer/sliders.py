"""Sliders for theta's numbers: what each is called, how far it goes, and in which unit."""

import math
from dataclasses import dataclass

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.export.driving import ThetaNames

_AXES = "xyz"
_UNITS = {
    "linear": ("", 1.0),
    "axis_angle": (" (deg)", math.degrees(1)),
    "translation": (" (mm)", 1e3),
}
_LEAST_REACH = {"linear": 1.0, "axis_angle": math.radians(20), "translation": 0.05}
_BEYOND = 0.25
_STEPS = 200

TITLES = {
    "jaw": "Jaw",
    "left_eye": "Eyes",
    "right_eye": "Eyes",
    "eyelids": "Eyelids",
    "neck": "Neck",
    "rotation": "Head pose",
    "translation": "Head pose",
}
"""The folder of each field; others stand under their own name."""


@dataclass(frozen=True)
class NumberSlider:
    """One number of theta; limits and step are in the shown unit."""

    place: int
    """Its place in theta."""
    field: str
    label: str
    low: float
    high: float
    step: float
    shown_per_unit: float
    """The shown number is this times theta's."""


def number_sliders(names: ThetaNames, statistics: TrainingStatistics) -> list[NumberSlider]:
    """A slider for each number of theta, expressions that moved most in training first.

    Each goes a quarter beyond what was seen, and at least to +-1, 20 degrees or 5 cm.
    """
    sliders = []
    for part in names.layout.fields:
        numbers = names.layout.slice(part.name)
        places = list(range(numbers.start, numbers.stop))
        if part.name == "expression":
            strength = statistics.theta_std.tolist()
            places.sort(key=lambda place: -strength[place])
        unit, factor = _UNITS[part.form]
        for place in places:
            seen_low = min(float(statistics.theta_min[place]), -_LEAST_REACH[part.form])
            seen_high = max(float(statistics.theta_max[place]), _LEAST_REACH[part.form])
            reach = _BEYOND * (seen_high - seen_low)
            low, high = factor * (seen_low - reach), factor * (seen_high + reach)
            label = _label(names, place, part.name, part.form, place - numbers.start)
            step = _round_step((high - low) / _STEPS)
            sliders.append(NumberSlider(place, part.name, label + unit, low, high, step, factor))
    return sliders


def _label(names: ThetaNames, place: int, field: str, form: str, number: int) -> str:
    if field == "expression":
        return names.numbers[place]
    plain = field.replace("_", " ")
    if form == "linear":
        return f"{plain} {('left', 'right')[number] if field == 'eyelids' else number}"
    return f"{plain} {_AXES[number]}"


def _round_step(step: float) -> float:
    """The next smaller of 1, 2 and 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(step))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= step * 1.0001)
