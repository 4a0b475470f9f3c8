"""Work done ahead in threads, in order and with little in memory."""

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from queue import Empty, Full, Queue
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
_POLL_S = 0.05
# A thread that is deep in a video it only skips through is not waited for.
_LEAVE_S = 5.0


def in_background(items: Iterable[Item], ahead: int) -> Generator[Item, None, None]:
    """The same items, made by another thread up to `ahead` of them early.

    An error in the making is raised here, after the items before it. Closing this iterator stops
    the thread.
    """
    queue: Queue[tuple[bool, Any]] = Queue(maxsize=max(1, ahead))
    stopped = threading.Event()

    def put(is_item: bool, value: Any) -> bool:
        while not stopped.is_set():
            with suppress(Full):
                queue.put((is_item, value), timeout=_POLL_S)
                return True
        return False

    def fill() -> None:
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

    thread = threading.Thread(target=fill, daemon=True)
    thread.start()
    try:
        while True:
            # In short steps, so that Ctrl-C is heard at once everywhere.
            try:
                is_item, value = queue.get(timeout=_POLL_S)
            except Empty:
                continue
            if is_item:
                yield value
            elif value is None:
                return
            else:
                raise value
    finally:
        stopped.set()
        thread.join(_LEAVE_S)


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
