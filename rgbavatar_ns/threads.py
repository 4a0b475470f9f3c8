"""How many threads torch uses, and with it the compiled loops."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def using_threads(count: int | None) -> Iterator[int]:
    """Let torch use this many threads within, for what the calling thread does; gives the number.

    One thread is for small operations right before or after compiled loops: GNU's OpenMP, which
    torch brings on Linux, lets the threads of an operation look for more work for ten milliseconds
    and longer (OMP_WAIT_POLICY, GOMP_SPINCOUNT), and on two cores the loops' own threads would
    share a core with them. A thread that begins to use torch while another one is within gets that
    one's number.
    """
    before = torch.get_num_threads()
    if count is not None:
        torch.set_num_threads(count)
    try:
        yield torch.get_num_threads()
    finally:
        torch.set_num_threads(before)
