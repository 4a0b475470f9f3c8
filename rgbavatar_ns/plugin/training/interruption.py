"""Ctrl-C, SIGTERM and the end of the command that started us, as a wish to stop."""

import os
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType

PARENT_VARIABLE = "RGBAVATAR_PARENT_PID"
"""Environment variable: the process that a command of ours belongs to, and ends with."""
_WATCH_INTERVAL_S = 0.2


def when_parent_ends(parent_pid: int, end: Callable[[], object]) -> None:
    """Call `end`, from a thread, once the parent of this process is another: its own has ended.

    A killed process can no longer end those that it started.
    """

    def watch() -> None:
        while os.getppid() == parent_pid:
            time.sleep(_WATCH_INTERVAL_S)
        end()

    threading.Thread(target=watch, name="rgbavatar parent", daemon=True).start()


def stop_with_starter() -> None:
    """Send this process SIGTERM, which saves, when the command of ours that started it is gone."""
    starter = os.environ.get(PARENT_VARIABLE, "")
    if starter == str(os.getppid()):
        when_parent_ends(int(starter), lambda: os.kill(os.getpid(), signal.SIGTERM))


class StopRequest:
    """While entered, the first SIGINT or SIGTERM is noted instead of breaking the step.

    A second signal acts as usual. Outside the main thread, where Python handles no signals,
    entering does nothing.
    """

    def __init__(self) -> None:
        self.signal_number: int | None = None
        self._event = threading.Event()
        self._before: dict[int, object] = {}

    @property
    def requested(self) -> bool:
        """Whether a stop was asked for."""
        return self._event.is_set()

    @property
    def exit_code(self) -> int:
        """128 + the signal's number, as shells report it: 130 after Ctrl-C, 143 after SIGTERM."""
        return 0 if self.signal_number is None else 128 + self.signal_number

    def request(self) -> None:
        """Ask for a stop from the program itself; the exit code stays 0."""
        self._event.set()

    def wait(self, seconds: float) -> bool:
        """Sleep until a stop is asked for, at most `seconds`; True if it was."""
        return self._event.wait(seconds)

    def __enter__(self) -> "StopRequest":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal_number = number
        self._restore()
        self._event.set()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before.clear()
