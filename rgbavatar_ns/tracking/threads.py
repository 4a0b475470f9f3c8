"""Work done ahead in threads, in order and with little in memory."""

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import Empty, Full, Queue
from typing import Generic, TypeVar

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
    queue: Queue[Item | _End] = Queue(maxsize=max(1, ahead))
    stopped = threading.Event()
    thread = threading.Thread(target=_fill, args=(items, queue, stopped), daemon=True)
    thread.start()
    try:
        while True:
            item = _take(queue)
            if isinstance(item, _End):
                if item.error is not None:
                    raise item.error
                return
            yield item
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


class _End(Generic[Item]):
    """Comes after the last item, with what went wrong."""

    def __init__(self, error: BaseException | None = None) -> None:
        self.error = error


def _fill(items: Iterable[Item], queue: "Queue[Item | _End]", stopped: threading.Event) -> None:
    iterator = iter(items)
    end = _End()
    try:
        for item in iterator:
            if not _put(queue, item, stopped):
                break
    except BaseException as error:
        end = _End(error)
    close = getattr(iterator, "close", None)
    if close is not None:
        close()
    _put(queue, end, stopped)


def _put(queue: "Queue[Item | _End]", item: "Item | _End", stopped: threading.Event) -> bool:
    while not stopped.is_set():
        try:
            queue.put(item, timeout=_POLL_S)
            return True
        except Full:
            continue
    return False


def _take(queue: "Queue[Item | _End]") -> "Item | _End":
    """Wait in short steps, so that Ctrl-C is heard at once everywhere."""
    while True:
        try:
            return queue.get(timeout=_POLL_S)
        except Empty:
            continue
