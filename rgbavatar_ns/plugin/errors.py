"""How a user's mistake is told under nerfstudio's commands."""

import sys
from collections.abc import Callable
from types import TracebackType

from rgbavatar_ns.errors import UserError

Hook = Callable[[type[BaseException], BaseException, TracebackType | None], object]


def tell_user_error(error: UserError) -> None:
    """Write cause and remedy to stderr, in two lines."""
    print(f"\nError: {error.cause}\n{error.remedy}", file=sys.stderr, flush=True)


def install_user_error_hook() -> None:
    """Let an uncaught `UserError` end the process with its message and exit code 1.

    nerfstudio's commands have no place for such errors, so this is Python's own hook; every
    other exception goes to the hook that was there before. Installing twice changes nothing.
    """
    if isinstance(sys.excepthook, _UserErrorHook):
        return
    sys.excepthook = _UserErrorHook(sys.excepthook)


class _UserErrorHook:
    def __init__(self, before: Hook) -> None:
        self.before = before

    def __call__(
        self, kind: type[BaseException], error: BaseException, trace: TracebackType | None
    ) -> None:
        if isinstance(error, UserError):
            tell_user_error(error)
        else:
            self.before(kind, error, trace)
