"""How far apart a performer's lips are measured while they are closed."""

import math
from collections import deque

import torch
from jaxtyping import Float
from torch import Tensor

_LOWEST = 0.1
"""Of what is seen this share may lie below closed lips: pressed ones, and a tracker's noise."""
_FALLS_IN_S = 0.3
"""Closer lips count soon, so that none stand open that are closed."""
_RISES_IN_S = 5.0
"""Pressed lips are forgotten slowly, so that what is said meanwhile opens the mouth."""
_MOST_BIAS_M = 0.003
"""What a tracker measures too much; lips that are farther apart than that are open."""
_RECENT = 600
"""Frames that are remembered: ten seconds of the quickest senders."""


class ClosedLips:
    """The gap in metres at which lips count as closed, learnt and followed.

    It falls to whatever is less. From there it rises again to what is least in the last seconds,
    at most to the gap of the calibration: a mouth that is kept open stays open.

    Args:
        gap_m: of the head's own closed lips, which counts before a calibration. A performer who is
            met with an open mouth is taken for one whose lips are measured 3 mm farther apart.
    """

    def __init__(self, gap_m: float) -> None:
        self.gap_m = gap_m
        self._calibrated_m = gap_m
        self._most_m = gap_m + _MOST_BIAS_M
        self._recent_m: deque[float] = deque(maxlen=_RECENT)

    def calibrate(self, gaps_m: Float[Tensor, "F"]) -> None:
        """Begin anew with the gaps of the frames in which the performer was met."""
        self.gap_m = self._calibrated_m = min(_least(gaps_m), self._most_m)
        self._recent_m = deque(gaps_m.tolist(), _RECENT)

    def follow(self, gap_m: float, seconds: float) -> float:
        """Take in the gap of a frame, so long after the one before; what counts as closed now."""
        self._recent_m.append(gap_m)
        self.gap_m += _share(seconds, _FALLS_IN_S) * min(gap_m - self.gap_m, 0.0)
        rest_m = min(self._calibrated_m, _least(torch.tensor(self._recent_m)))
        self.gap_m += _share(seconds, _RISES_IN_S) * max(rest_m - self.gap_m, 0.0)
        return self.gap_m


def _least(gaps_m: Float[Tensor, "F"]) -> float:
    return float(torch.quantile(gaps_m, _LOWEST))


def _share(seconds: float, time_constant_s: float) -> float:
    return 1 - math.exp(-seconds / time_constant_s)
