"""Single keys while a command runs, where it runs in a terminal."""

import contextlib
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

_LOOK_S = 0.2


@contextmanager
def on_keys(actions: Mapping[str, Callable[[], None]]) -> Iterator[bool]:
    """Call an action for each key that is pressed; the value given is whether keys are heard.

    Nothing is heard where standard input is no terminal, or another program's, or the system knows
    no terminals. Ctrl-C stays what it is.
    """
    try:
        import termios
        import tty
    except ImportError:
        yield False
        return
    try:
        terminal = sys.stdin.fileno()
        before = termios.tcgetattr(terminal)
    except (OSError, ValueError, termios.error):
        yield False
        return
    if _in_background(terminal):
        yield False
        return
    ended = threading.Event()

    def listen() -> None:
        while not ended.is_set():
            ready, _, _ = select.select([terminal], [], [], _LOOK_S)
            key = os.read(terminal, 1).decode("ascii", "ignore") if ready else ""
            if key in actions:
                actions[key]()

    tty.setcbreak(terminal)
    threading.Thread(target=listen, name="keys", daemon=True).start()
    try:
        yield True
    finally:
        ended.set()
        with contextlib.suppress(termios.error):
            termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _in_background(terminal: int) -> bool:
    """Whether the terminal is another program's now, so that changing it would stop this one."""
    try:
        return os.tcgetpgrp(terminal) != os.getpgrp()
    except OSError:  # It controls no process here.
        return False
