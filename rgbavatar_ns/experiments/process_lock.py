"""That a cell is run by one process at a time, and by none that has been forgotten."""

import fcntl
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_LOCK_FILE = ".lock"
_WATCH_INTERVAL_S = 1.0
_SECONDS_TO_SAVE = 60.0


@contextmanager
def alone_in(
    folder: Path, tell: Callable[[str], None] = lambda line: print(line, flush=True)
) -> Iterator[None]:
    """Hold the folder's lock; waits, and tells so, while another process does.

    The lock goes with the process.
    """
    with (folder / _LOCK_FILE).open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            tell("Another process still works on this cell; waiting for it.")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def end_with_parent() -> None:
    """Interrupt this process's group, which it leads, once its parent is gone; later kill it.

    A worker that a cluster or the system has killed can no longer end its cell.
    """
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_INTERVAL_S)
        for number in (signal.SIGINT, signal.SIGKILL):
            os.killpg(0, number)
            time.sleep(_SECONDS_TO_SAVE)

    if os.getpgrp() == os.getpid():
        threading.Thread(target=watch, daemon=True).start()
