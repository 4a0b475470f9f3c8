"""The lock that training and the viewer's pictures take in turn."""

import threading
from collections import deque


class TurnsLock:
    """Given in the order in which it is asked for.

    A plain lock goes back to the thread that has just released it, so that a picture may wait for
    many steps.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._queue: deque[object] = deque()
        """Who holds it, and who waits."""

    def __enter__(self) -> None:
        turn = object()
        with self._changed:
            self._queue.append(turn)
            try:
                self._changed.wait_for(lambda: self._queue[0] is turn)
            except BaseException:  # A second Ctrl-C.
                self._queue.remove(turn)
                self._changed.notify_all()
                raise

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._queue.popleft()
            self._changed.notify_all()
