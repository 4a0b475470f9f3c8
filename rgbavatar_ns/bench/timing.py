"""Repeated timings, and how much memory a call needs."""

import ctypes
import re
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

Progress = Callable[[str, int, int], None]
"""Called with (what is timed, timings done, timings in all), never while the clock runs."""

Lap = Callable[[str], None]
"""Called by what is timed, at the end of a part, with the part's name."""

WHOLE = "whole"
CPU = torch.device("cpu")


def waiting_for(device: torch.device) -> Callable[[], None]:
    """Return what waits until the device has done all that it was given; on a CPU nothing."""
    if device.type == "cuda":
        return lambda: torch.cuda.synchronize(device)
    return lambda: None


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


class Stopwatch:
    """Times calls `repetitions` times after a warm-up, and says how far it is.

    `wait` is called whenever the clock is read: what a device still has to do belongs to the part
    that asked for it.
    """

    def __init__(
        self,
        repetitions: int,
        progress: Progress | None = None,
        *,
        warm_up: bool = True,
        wait: Callable[[], None] | None = None,
    ) -> None:
        self.repetitions, self._wait = repetitions, wait or waiting_for(CPU)
        self._warm_up = warm_up
        self._progress = progress or (lambda what, done, total: None)

    def time(
        self, what: str, call: Callable[[], Any], prepare: Callable[[], Any] | None = None
    ) -> Spread:
        """Time a call; `prepare` runs before each one, outside of the time."""
        return self.laps(what, lambda lap: call(), prepare)[WHOLE]

    def laps(
        self, what: str, call: Callable[[Lap], Any], prepare: Callable[[], Any] | None = None
    ) -> dict[str, Spread]:
        """Time a call and the parts that it marks; the call itself is under "whole"."""
        seconds: dict[str, list[float]] = {}
        for repetition in range(-int(self._warm_up), self.repetitions):
            self._progress(what, max(repetition, 0), self.repetitions)
            if prepare is not None:
                prepare()
            marks: list[tuple[str, float]] = []
            start = self._now()
            call(lambda name, marks=marks: marks.append((name, self._now())))
            end = self._now()
            if repetition < 0:
                continue
            last = start
            for name, mark in marks:
                seconds.setdefault(name, []).append(mark - last)
                last = mark
            seconds.setdefault(WHOLE, []).append(end - start)
        self._progress(what, self.repetitions, self.repetitions)
        return {name: Spread.of(values) for name, values in seconds.items()}

    def _now(self) -> float:
        self._wait()
        return time.perf_counter()


@contextmanager
def using_threads(count: int | None) -> Iterator[int]:
    """Let torch use this many threads within; gives the number used."""
    before = torch.get_num_threads()
    if count is not None:
        torch.set_num_threads(count)
    try:
        yield torch.get_num_threads()
    finally:
        torch.set_num_threads(before)


PEAK_MEMORY_METHOD = (
    "peak resident memory of the process during one call (VmHWM, reset before it) less the "
    "resident memory before it, freed memory handed back first; outputs, gradients and buffers "
    "that are kept for later calls are in it, inputs and what earlier calls kept are not"
)


GPU_MEMORY_METHOD = (
    "peak of the GPU memory in torch's tensors during one call less that before it; outputs, "
    "gradients and buffers that are kept for later calls are in it, inputs are not"
)


def peak_memory_method(device: torch.device) -> str:
    """What `peak_growth_bytes` measures there."""
    return GPU_MEMORY_METHOD if device.type == "cuda" else PEAK_MEMORY_METHOD


def peak_growth_bytes(call: Callable[[], Any], device: torch.device = CPU) -> int | None:
    """How far the memory in use rose above its level before the call (see `peak_memory_method`).

    None where the system does not tell: on a CPU it needs Linux's /proc.
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
