"""What the C library does with memory that a step has freed."""

import ctypes

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
"""Parameters of glibc's mallopt (malloc.h)."""


def keep_freed_memory() -> bool:
    """Let this process use large blocks again, instead of giving each back to the system.

    A step through autograd makes and frees hundreds of megabytes, and what comes from the system
    anew comes page by page, each cleared: a third of the step's time. The process keeps its peak
    from then on, and holes between what it keeps can make that larger. False where the C library
    is not glibc, whose habits stay what they are.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):  # no C library to ask, or another one
        return False
    return all([mallopt(_MMAP_MAX, 0) == 1, mallopt(_TRIM_THRESHOLD, -1) == 1])
