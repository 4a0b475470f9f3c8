"""The one-euro filter against jitter (Casiez, Roussel and Vogel, CHI 2012)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.options import CheckedOptions, Positive, Weight


@dataclass(frozen=True)
class OneEuroOptions(CheckedOptions):
    """How much is smoothed; at 0 < speed the cutoff is min_cutoff_hz + beta * speed."""

    min_cutoff_hz: Positive = 1.5
    """Cutoff at rest: lower removes more jitter and lags more."""
    beta: Weight = 2.0
    """How fast the cutoff rises with speed, in Hz for each unit (or radian) a second."""
    derivative_cutoff_hz: Positive = 1.0
    """Cutoff of the speed itself, as in the paper."""


def one_euro(
    values: Float[Tensor, "F D"], frames_per_second: float, options: OneEuroOptions | None = None
) -> Float[Tensor, "F D"]:
    """Smooth each column over time with a cutoff that rises with its speed; looks back only.

    Rotations may come as axis-angle vectors, as long as they stay below half a turn. At a steady
    speed v the result lags by v / (2 pi cutoff), less one frame at most.
    """
    options = OneEuroOptions() if options is None else options
    result = values.clone()
    if len(values) == 0:
        return result
    speed = torch.zeros_like(values[0])
    slow = _share(torch.full_like(speed, options.derivative_cutoff_hz), frames_per_second)
    for frame in range(1, len(values)):
        measured = (values[frame] - result[frame - 1]) * frames_per_second
        speed = torch.lerp(speed, measured, slow)
        cutoff = options.min_cutoff_hz + options.beta * speed.abs()
        share = _share(cutoff, frames_per_second)
        result[frame] = torch.lerp(result[frame - 1], values[frame], share)
    return result


def _share(cutoff_hz: Float[Tensor, "D"], frames_per_second: float) -> Float[Tensor, "D"]:
    """The new value's weight in an exponential average with this cutoff."""
    time_constant = 1 / (2 * math.pi * cutoff_hz)
    return 1 / (1 + time_constant * frames_per_second)
