"""The error that a user can cause: it names the cause and the remedy."""

import errno
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from itertools import islice


class UserError(Exception):
    """A mistake in input or set-up, told without a traceback by every command of ours.

    `cause` says what is wrong and where; `remedy` says what to do about it. Both may quote what a
    stranger wrote: what could command a terminal becomes "?", what is endless is cut.
    """

    def __init__(self, cause: str, remedy: str) -> None:
        self.cause = _printable(cause)
        self.remedy = _printable(remedy)
        super().__init__(f"{self.cause} {self.remedy}")


def told_as_user_error(error: OSError) -> UserError | None:
    """What the system refused, where that is the user's to mend: a path, a right, a full disk.

    For the doors of the house, where it would end in a traceback; None for what may be our fault.
    """
    remedy = _SYSTEM_REMEDIES.get(error.errno or 0)
    if remedy is None:
        return None
    place = f" {error.filename}" if error.filename else ""
    return UserError(f"The system refuses{place}: {error.strerror}.", remedy)


@contextmanager
def told_without_traceback(command: str) -> Iterator[None]:
    """Print what a user can mend as `command: cause remedy`, and exit with code 1.

    So is what the system refuses (`told_as_user_error`).
    """
    try:
        yield
    except (UserError, OSError) as error:
        told = told_as_user_error(error) if isinstance(error, OSError) else error
        if told is None:
            raise
        print(f"{command}: {told}", file=sys.stderr)
        sys.exit(1)


_FREE_SPACE = "Free some space, or name another place."
_PATHS_FAULTS = "EACCES EPERM ENAMETOOLONG ENOENT ENOTDIR EISDIR ELOOP EEXIST ENXIO ENOTEMPTY"
_SYSTEM_REMEDIES = {
    errno.ENOSPC: _FREE_SPACE,
    errno.EDQUOT: _FREE_SPACE,
    errno.EROFS: "Name a place that can be written.",
    errno.EIO: "Check the disk.",
    errno.EMFILE: "Close other programs, or allow more open files (ulimit -n).",
} | {
    getattr(errno, name): "Check the path, and that you may read or write there."
    for name in _PATHS_FAULTS.split()
}
_LONGEST_TOLD = 2000


def _printable(text: str) -> str:
    """The text without characters that a terminal obeys or cannot show."""
    if len(text) > _LONGEST_TOLD:
        text = f"{text[: _LONGEST_TOLD // 2]} ... {text[-_LONGEST_TOLD // 2 :]}"
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


def first_few(names: Collection[object], shown: int = 5) -> str:
    """The first of several names or numbers, and that there are more."""
    told = ", ".join(map(str, islice(names, shown)))
    return told if len(names) <= shown else f"{told}, ..."
