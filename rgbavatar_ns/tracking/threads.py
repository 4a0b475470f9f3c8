"""Work done ahead in threads, in order and with little in memory."""

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from queue import Empty, Full, Queue
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
_POLL_S = 0.05
# A thread that is deep in a video it only skips through is not waited for.
_LEAVE_S = 5.0


class InBackground(Iterator[Item]):
    """The same items, made by another thread up to `ahead` of them early.

    The thread begins with the first item that is asked for. An error in the making is raised here,
    after the items before it. Closing stops the thread, and may be done by any other, also while
    one waits here for an item.
    """

    def __init__(self, items: Iterable[Item], ahead: int) -> None:
        self._queue: Queue[tuple[bool, Any]] = Queue(maxsize=max(1, ahead))
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None
        self._items: Iterable[Item] | None = items

    def __next__(self) -> Item:
        if self._items is not None:
            # The thread knows nothing of this object, so that it ends with it.
            filled = (self._items, self._queue, self._stopped)
            self._thread = threading.Thread(target=_fill, args=filled, daemon=True)
            self._items = None
            self._thread.start()
        while not self._stopped.is_set():
            # In short steps, so that Ctrl-C is heard at once everywhere.
            try:
                is_item, value = self._queue.get(timeout=_POLL_S)
            except Empty:
                continue
            if is_item:
                return value
            self.close()
            if value is not None:
                raise value
        raise StopIteration

    def close(self) -> None:
        """Make no more items."""
        self._items = None
        self._stopped.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_LEAVE_S)

    def __del__(self) -> None:
        self._stopped.set()


def _fill(
    items: Iterable[Item], queue: "Queue[tuple[bool, Any]]", stopped: threading.Event
) -> None:
    def put(is_item: bool, value: Any) -> bool:
        while not stopped.is_set():
            with suppress(Full):
                queue.put((is_item, value), timeout=_POLL_S)
                return True
        return False

    iterator, error = iter(items), None
    try:
        for item in iterator:
            if not put(True, item):
                break
    except BaseException as raised:
        error = raised
    close = getattr(iterator, "close", None)
    if close is not None:
        close()
    put(False, error)


def map_in_order(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Generator[Result, None, None]:
    """function(item) for each item, in order, on `workers` threads that stay a little ahead."""
    pending: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(workers, "rgbavatar-track") as pool:
        try:
            for item in items:
                pending.append(pool.submit(function, item))
                if len(pending) > workers:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()
