"""How long a run has trained."""

import time
from collections.abc import Callable

import torch


class TrainClock:
    """Sums up the seconds of training steps, evaluation and saving apart.

    A GPU's step returns to the host before it is done. So whoever asks for the seconds, or uses the
    device for something else, has the clock `settle` first: what the steps left the device to do is
    waited for, and counts.

    Args:
        wait: returns when the device has done what it was told; None for a CPU, which always has.
        now: the time in seconds.
    """

    def __init__(
        self, wait: Callable[[], None] | None, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._wait, self._now = wait, now
        self.seconds = 0.0
        self._steps, self._seconds_before, self._per_step = 0, 0.0, 0.0

    def add(self, seconds: float) -> None:
        """Count a step by the seconds after which it returned."""
        self.seconds += seconds
        self._steps += 1

    def settle(self) -> None:
        """Wait for the device, and count that too."""
        if self._wait is not None:
            began = self._now()
            self._wait()
            self.seconds += self._now() - began
        if self._steps > 0:
            self._per_step = (self.seconds - self._seconds_before) / self._steps
            self._steps, self._seconds_before = 0, self.seconds

    def reaches(self, seconds: float) -> bool:
        """Whether so many have passed; settles only where, by its steps so far, they may have."""
        expected = self.seconds + (self._steps + 1) * self._per_step
        if self._steps > 0 and (self._per_step == 0 or expected >= seconds):
            self.settle()
        return self.seconds >= seconds

    @property
    def seconds_per_step(self) -> float:
        """Mean of the steps between the last two times it settled."""
        return self._per_step

    def resume(self, seconds: float) -> None:
        """Go on from the seconds of the sessions before."""
        self.seconds = self._seconds_before = seconds


def waiting_for(device: str | torch.device) -> Callable[[], None] | None:
    """What returns when `device` has done all that it was told; None for a CPU."""
    if torch.device(device).type != "cuda":
        return None
    return lambda: torch.cuda.synchronize(device)
