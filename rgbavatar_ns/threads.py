"""How many threads torch uses, and with it the compiled loops."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch


@dataclass
class _Within:
    """How many blocks are open in all threads, and the numbers that count for a new thread: outside
    of any block, and as torch gives it, the latest that was set.
    """

    lock: threading.Lock = field(default_factory=threading.Lock)
    blocks: int = 0
    usual: int = 0
    latest: int = 0
    thread: threading.local = field(default_factory=threading.local)


_within = _Within()


@contextmanager
def using_threads(count: int | None) -> Iterator[int]:
    """Let torch use this many threads within, for what the calling thread does; gives the number.

    One thread is for small operations right before or after compiled loops: GNU's OpenMP, which
    torch brings on Linux, lets the threads of an operation look for more work for ten milliseconds
    and longer (OMP_WAIT_POLICY, GOMP_SPINCOUNT), and on two cores the loops' own threads would
    share a core with them. A thread that begins to use torch while another one is within gets that
    one's number from torch; if it comes here, only until it has left.
    """
    with _within.lock:
        before = torch.get_num_threads()
        if before == _within.latest and not hasattr(_within.thread, "known"):
            before = _within.usual  # it may have asked torch first while another was within
        elif _within.blocks == 0:
            _within.usual = before
        _within.thread.known = True
        _within.blocks += 1
        _within.latest = before if count is None else count
        torch.set_num_threads(_within.latest)
    try:
        yield torch.get_num_threads()
    finally:
        with _within.lock:
            _within.blocks -= 1
            torch.set_num_threads(before)
