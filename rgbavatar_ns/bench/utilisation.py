"""The share of a GPU that a call keeps busy, as its driver counts it (NVML)."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from rgbavatar_ns.bench.timing import waiting_for

_SECONDS, _SETTLING_SECONDS = 3.0, 1.0
_SECONDS_PER_READING = 0.05


@dataclass(frozen=True)
class Utilisation:
    """Mean utilisation in percent, None where there is none, and how it came about or why not."""

    percent: float | None
    note: str | None


def gpu_utilisation(call: Callable[[], Any], device: torch.device) -> Utilisation:
    """Repeat the call for some seconds and ask the driver how busy the GPU is meanwhile.

    Nothing is repeated on a CPU, or where the driver cannot be asked.
    """
    if device.type != "cuda":
        return Utilisation(None, None)

    def read() -> float:
        return torch.cuda.utilization(device)

    try:
        read()
    # torch passes on what NVML raises, whose classes are pynvml's.
    except Exception as error:
        return Utilisation(None, f"{type(error).__name__}: {error}")
    percent = mean_while_busy(call, read, waiting_for(device))
    return Utilisation(percent, f"NVML, mean over {_SECONDS:g} s of steps without a pause")


def mean_while_busy(
    call: Callable[[], Any],
    read: Callable[[], float],
    wait: Callable[[], None],
    seconds: float = _SECONDS,
    settling_seconds: float = _SETTLING_SECONDS,
) -> float:
    """The mean of what is read while the call is repeated for so many seconds.

    NVML's readings look back for up to a second, so the first are left out: `settling_seconds` of
    calls come before the others.
    """
    readings: list[float] = []
    done = threading.Event()

    def keep_reading() -> None:
        while not done.wait(_SECONDS_PER_READING):
            readings.append(read())

    reader = threading.Thread(target=keep_reading, daemon=True)
    _repeat(call, settling_seconds)
    reader.start()
    _repeat(call, seconds)
    done.set()
    reader.join()
    wait()
    return sum(readings) / len(readings) if readings else read()


def _repeat(call: Callable[[], Any], seconds: float) -> None:
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        call()
