"""The error that a user can cause: it names the cause and the remedy."""

from collections.abc import Collection
from itertools import islice


class UserError(Exception):
    """A mistake in input or set-up, told without a traceback by every command of ours.

    `cause` says what is wrong and where; `remedy` says what to do about it.
    """

    def __init__(self, cause: str, remedy: str) -> None:
        self.cause = cause
        self.remedy = remedy
        super().__init__(f"{cause} {remedy}")


def first_few(names: Collection[object], shown: int = 5) -> str:
    """The first of several names or numbers, and that there are more."""
    told = ", ".join(map(str, islice(names, shown)))
    return told if len(names) <= shown else f"{told}, ..."
