"""A proof that nothing waits: a step returns while the GPU still sleeps."""

import time
from collections.abc import Callable
from typing import Any

import torch

from benchmarks.gpu.rows import Figures, Rows, check
from benchmarks.gpu.workload import Training, Workload

SLEEP_S = 0.25
_TRIED_CYCLES = 10_000_000
MOST_OF_THE_SLEEP = 0.5

Sleep = Callable[[], None]
"""Puts the GPU to sleep for about SLEEP_S, and returns at once."""


def waits(rows: Rows) -> None:
    """For the recorded step and for the one that starts kernel by kernel."""
    work = Workload.here()
    with rows.row("sleep") as figures:
        sleep, figures["cycles"] = sleeping(work)
    for kind in ("recorded", "fused"):
        with rows.row(kind) as figures:
            take = getattr(Training(work), kind)()
            take()
            figures |= returned(work, take, sleep)


def sleeping(work: Workload) -> tuple[Sleep, int]:
    """The sleep, and the cycles that it takes, by what a short one took."""
    if not work.on_gpu:
        return lambda: None, 0
    sleep: Any = torch.cuda._sleep
    sleep(1)  # what a first call loads
    work.wait()
    start = time.perf_counter()
    sleep(_TRIED_CYCLES)
    work.wait()
    cycles = int(_TRIED_CYCLES * SLEEP_S / (time.perf_counter() - start))
    return lambda: sleep(cycles), cycles


def returned(work: Workload, call: Callable[[], Any], sleep: Sleep) -> Figures:
    """When the call came back, and when the GPU had done it, both from the sleep's beginning."""
    work.wait()
    start = time.perf_counter()
    sleep()
    call()
    back_s = time.perf_counter() - start
    work.wait()
    done_s = time.perf_counter() - start
    figures: Figures = {"returned_ms": 1e3 * back_s, "done_ms": 1e3 * done_s}
    if work.on_gpu:
        check(figures, done_s > SLEEP_S / 2, "the GPU did not sleep, so this shows nothing")
        check(figures, back_s < MOST_OF_THE_SLEEP * done_s, "it waits for the GPU")
    return figures
