"""Repeated timings, and how much memory a call needs."""

import ctypes
import re
import statistics
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.utils import benchmark

Progress = Callable[[str, int, int], None]
"""Called with (what is timed, timings done, timings in all), never while the clock runs."""

Lap = Callable[[str], None]
"""Called by what is timed, at the end of a part, with the part's name."""

WHOLE = "whole"
CPU = torch.device("cpu")


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of repeated timings, in milliseconds."""

    median_ms: float
    lower_ms: float
    upper_ms: float
    repetitions: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> "Spread":
        """The spread of one or more timings in seconds."""
        times_ms = [1e3 * value for value in seconds]
        if len(times_ms) == 1:
            return cls(times_ms[0], times_ms[0], times_ms[0], 1)
        lower, median, upper = statistics.quantiles(times_ms, n=4, method="inclusive")
        return cls(median, lower, upper, len(times_ms))


@dataclass(frozen=True)
class Stopwatch:
    """Times calls `repetitions` times after a warm-up, and says how far it is.

    By the clock of `torch.utils.benchmark`, which waits for a GPU: what it still has to do belongs
    to the part that asked for it. Its `Timer` neither marks parts nor prepares each call.
    """

    repetitions: int
    progress: Progress | None = None
    warm_up: bool = True
    clock: Callable[[], float] = benchmark.timer

    def time(
        self, what: str, call: Callable[[], Any], prepare: Callable[[], Any] = lambda: None
    ) -> Spread:
        """Time a call; `prepare` runs before each one, outside of the time."""
        return self.laps(what, lambda lap: call(), prepare)[WHOLE]

    def laps(
        self, what: str, call: Callable[[Lap], Any], prepare: Callable[[], Any] = lambda: None
    ) -> dict[str, Spread]:
        """Time a call and the parts that it marks; the call itself is under "whole"."""
        seconds: dict[str, list[float]] = {}
        for repetition in range(-int(self.warm_up), self.repetitions):
            self._tell(what, max(repetition, 0))
            prepare()
            marks: list[tuple[str, float]] = []
            start = last = self.clock()
            call(lambda name, marks=marks: marks.append((name, self.clock())))
            end = self.clock()
            if repetition < 0:
                continue
            for name, mark in marks:
                seconds.setdefault(name, []).append(mark - last)
                last = mark
            seconds.setdefault(WHOLE, []).append(end - start)
        self._tell(what, self.repetitions)
        return {name: Spread.of(values) for name, values in seconds.items()}

    def _tell(self, what: str, done: int) -> None:
        if self.progress is not None:
            self.progress(what, done, self.repetitions)


def peak_growth_bytes(call: Callable[[], Any], device: torch.device = CPU) -> int | None:
    """How far the memory in use rose above its level before the call, at most.

    On a GPU that of torch's tensors; else the process's resident memory (VmHWM, reset before; freed
    memory is handed back first), None where the system does not tell. What is kept for later calls,
    such as gradients, is in it; inputs and what earlier calls kept are not.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        call()
        return torch.cuda.max_memory_allocated(device) - before
    # With another C library, what it has freed but kept makes the growth look smaller.
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")
        before = _status_bytes("VmRSS")
    except (OSError, LookupError):
        return None
    call()
    return max(_status_bytes("VmHWM") - before, 0)


def _status_bytes(field: str) -> int:
    found = re.search(rf"^{field}:\s*(\d+) kB", Path("/proc/self/status").read_text(), re.M)
    if found is None:
        raise LookupError(field)
    return 1024 * int(found[1])
