"""Sliders for theta's numbers: what each is called, how far it goes, and in which unit."""

import math
import re
from dataclasses import dataclass

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.driving.theta_map import ThetaNames

_UNITS = {
    "linear": ("", "as the tracker counts", 1.0),
    "axis_angle": (" (°)", "degrees", math.degrees(1)),
    "translation": (" (mm)", "millimetres", 1e3),
}
_LEAST_REACH = {"linear": 1.0, "axis_angle": math.radians(20), "translation": 0.05}
_BEYOND = 0.25
_ONE_WAY = ("jaw", 0)
"""The field and number that go to one side only: a mouth is open or closed."""
_STEPS = 200
_LEAST_WEIGHT = 1.0

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

# By field, what each number does; where + goes, as the person sees left and right.
_TURN = (("nods", "down"), ("turns", "to the left"), ("tilts", "to the right shoulder"))
_GAZE = (("up-down", "down"), ("sideways", "to the left"), ("rolls", "to the right shoulder"))
_MEANINGS = {
    "jaw": ("Jaw", (("opens", "opens"), ("sideways", "to the left"), ("twists", "to the right"))),
    "left_eye": ("Left eye", _GAZE),
    "right_eye": ("Right eye", _GAZE),
    "neck": ("Neck", _TURN),
    "rotation": ("Head", _TURN),
    "translation": (
        "Head",
        (("sideways", "to the left"), ("up-down", "up"), ("forward", "towards the viewer")),
    ),
}


@dataclass(frozen=True)
class NumberSlider:
    """One number of theta; limits and step are in the shown unit."""

    place: int
    """Its place in theta."""
    field: str
    label: str
    hint: str
    low: float
    high: float
    step: float
    marks: tuple[float, float]
    """Where the film ends."""
    shown_per_unit: float
    """The shown number is this times theta's."""

    def shown(self, number: float) -> float:
        """The slider's place for theta's number, in whole steps, so that it can be read."""
        return on_step(min(max(number * self.shown_per_unit, self.low), self.high), self.step)


@dataclass(frozen=True)
class WeightSlider:
    """The weight of one basis, psi; goes half beyond what was seen, and at least to +-1."""

    low: float
    high: float
    step: float
    marks: tuple[float, float]
    """Where the film ends."""
    hint: str

    def shown(self, weight: float) -> float:
        """The slider's place for a weight."""
        return on_step(min(max(weight, self.low), self.high), self.step)


def weight_sliders(statistics: TrainingStatistics) -> list[WeightSlider]:
    """A slider for each basis."""
    sliders = []
    for low, high in zip(statistics.psi_min.tolist(), statistics.psi_max.tolist()):
        reach = max(_LEAST_WEIGHT, 1.5 * max(high, -low))
        ends = slider_ends(-reach, reach)
        marks = on_step(low, ends[2]), on_step(high, ends[2])
        hint = f"How much of this change is added (psi); in training {marks[0]:g} to {marks[1]:g}"
        sliders.append(WeightSlider(*ends, marks, hint))
    return sliders


def number_sliders(names: ThetaNames, statistics: TrainingStatistics) -> list[NumberSlider]:
    """A slider for each number of theta, expressions that moved most in training first.

    Each goes a quarter beyond what was seen, and at least to +-1, 20 degrees or 5 cm; the jaw only
    opens.
    """
    sliders = []
    for part in names.layout.fields:
        numbers = names.layout.slice(part.name)
        places = list(range(numbers.start, numbers.stop))
        if part.name == "expression":
            strength = statistics.theta_std.tolist()
            places.sort(key=lambda place: -strength[place])
        sign, unit, factor = _UNITS[part.form]
        for place in places:
            seen = statistics.theta_min[place], statistics.theta_max[place]
            low = min(float(seen[0]), -_LEAST_REACH[part.form])
            high = max(float(seen[1]), _LEAST_REACH[part.form])
            reach = _BEYOND * (high - low)
            low, high = low - reach, high + reach
            if (part.name, place - numbers.start) == _ONE_WAY:
                low = 0.0
            low, high, step = slider_ends(factor * low, factor * high)
            label, goes = _meaning(names, place, part.name, place - numbers.start)
            shown = [on_step(factor * float(end), step) for end in seen]
            marks = min(max(shown[0], low), high), min(max(shown[1], low), high)
            hint = f"In {unit}{goes}; in training {shown[0]:g} to {shown[1]:g}"
            sliders.append(
                NumberSlider(place, part.name, label + sign, hint, low, high, step, marks, factor)
            )
    return sliders


def slider_ends(low: float, high: float) -> tuple[float, float, float]:
    """Ends of a slider in whole steps, and a step that is read at a glance, some 200 of them."""
    power = 10.0 ** math.floor(math.log10((high - low) / _STEPS))
    step = max(n * power for n in (1, 2, 5) if n * power <= (high - low) / _STEPS * 1.0001)
    return on_step(low, step), on_step(high, step), step


def on_step(value: float, step: float) -> float:
    """The nearest whole number of steps, without the digits that floats leave behind."""
    return round(round(value / step) * step, digits_of(step)) + 0.0


def digits_of(step: float) -> int:
    """Digits behind the point of whole numbers of steps."""
    return max(0, -math.floor(math.log10(step)))


def _meaning(names: ThetaNames, place: int, field: str, number: int) -> tuple[str, str]:
    """What a number is called, and where + goes."""
    if field in _MEANINGS:
        what, numbers = _MEANINGS[field]
        return f"{what} {numbers[number][0]}", f", + {numbers[number][1]}"
    if field == "eyelids":
        return f"{('Left', 'Right')[number]} eyelid", ", + closes"
    plain = names.numbers[place] if field == "expression" else f"{field} {number + 1}"
    # A label of several words wraps where one long word would run under its slider.
    words = re.sub(r"(?<=[a-z])(?=[A-Z0-9])|_", " ", plain).lower()
    return words[:1].upper() + words[1:], ""
