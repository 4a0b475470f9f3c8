"""The one-euro filter against jitter (Casiez, Roussel and Vogel, CHI 2012)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.options import CheckedOptions, Positive, Weight

GAP_S = 0.5
"""After a longer gap a face may be anywhere: nothing is smoothed across it."""


@dataclass(frozen=True)
class OneEuroOptions(CheckedOptions):
    """How much is smoothed; at 0 < speed the cutoff is min_cutoff_hz + beta * speed."""

    min_cutoff_hz: Positive = 1.5
    """Cutoff at rest: lower removes more jitter and lags more."""
    beta: Weight = 2.0
    """How fast the cutoff rises with speed, in Hz for each unit (or radian) a second."""
    derivative_cutoff_hz: Positive = 1.0
    """Cutoff of the speed itself, as in the paper."""


class OneEuroFilter:
    """Smooths one vector after the other, each number with a cutoff that rises with its speed.

    Looks back only. Rotations may come as axis-angle vectors, as long as they stay below half a
    turn. At a steady speed v the result lags by v / (2 pi cutoff), less one frame at most.
    After a gap of `GAP_S` it begins anew.
    """

    def __init__(self, options: OneEuroOptions | None = None) -> None:
        self._options = OneEuroOptions() if options is None else options
        self._last: Tensor | None = None
        self._speed: Tensor | None = None

    def __call__(self, values: Float[Tensor, "D"], seconds: float) -> Float[Tensor, "D"]:
        """The next vector, so many seconds after the one before it; the first is as it comes."""
        if self._last is None or self._speed is None or not 0 < seconds < GAP_S:
            self._last, self._speed = values.clone(), torch.zeros_like(values)
            return self._last
        options, rate = self._options, 1 / seconds
        measured = (values - self._last) * rate
        slow = torch.full_like(values, options.derivative_cutoff_hz)
        self._speed = torch.lerp(self._speed, measured, _share(slow, rate))
        cutoff = options.min_cutoff_hz + options.beta * self._speed.abs()
        self._last = torch.lerp(self._last, values, _share(cutoff, rate))
        return self._last


def one_euro(
    values: Float[Tensor, "F D"],
    frames_per_second: float,
    options: OneEuroOptions | None = None,
    moments: Sequence[int] | None = None,
) -> Float[Tensor, "F D"]:
    """Smooth each column of a whole performance (`OneEuroFilter`).

    moments: when each row was filmed, in frames, rising; by default one after another.
    """
    smoothed = OneEuroFilter(options)
    filmed = range(len(values)) if moments is None else moments
    steps = [0, *(later - earlier for earlier, later in pairwise(filmed))]
    rows = [smoothed(row, step / frames_per_second) for row, step in zip(values, steps)]
    return torch.stack(rows) if rows else values.clone()


def _share(cutoff_hz: Float[Tensor, "D"], frames_per_second: float) -> Float[Tensor, "D"]:
    """The new value's weight in an exponential average with this cutoff."""
    time_constant = 1 / (2 * math.pi * cutoff_hz)
    return 1 / (1 + time_constant * frames_per_second)
