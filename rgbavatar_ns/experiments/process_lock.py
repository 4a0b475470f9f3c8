"""That one process at a time runs a cell, or sweeps into a folder, and none that is forgotten."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import hold_lock
from rgbavatar_ns.plugin.training.interruption import when_parent_ends

_LOCK_FILE = ".lock"
_WAITING = "Another process still works on this cell; waiting for it."
_SECONDS_TO_SAVE = 60.0


@contextmanager
def alone_in(
    folder: Path, tell: Callable[[str], None] = lambda line: print(line, flush=True)
) -> Iterator[None]:
    """Hold the folder's lock; waits, and tells so, while another process does.

    The lock goes with the process.
    """
    with hold_lock(folder / _LOCK_FILE, lambda: tell(_WAITING)):
        yield


@contextmanager
def alone_in_sweep(folder: Path) -> Iterator[None]:
    """Hold a sweep's folder; raises UserError while another process sweeps into it.

    Both would draw the same datasets and write the same logs.
    """

    def refuse() -> None:
        raise UserError(
            f"Another process sweeps into {folder}.",
            "Wait for it or stop it; the same command then goes on. Or name another --output.",
        )

    folder.mkdir(parents=True, exist_ok=True)
    with hold_lock(folder / _LOCK_FILE, refuse):
        yield


def end_with_parent(parent_pid: int) -> None:
    """Interrupt this process's group, which it leads, once its parent is gone; later kill it.

    A worker that a cluster or the system has killed can no longer end its cell. The parent names
    itself: it may be gone before this process comes to ask.
    """

    def end() -> None:
        for number in (signal.SIGINT, signal.SIGKILL):
            os.killpg(0, number)
            time.sleep(_SECONDS_TO_SAVE)

    if os.getpgrp() == os.getpid():
        when_parent_ends(parent_pid, end)
