"""The error that a user can cause: it names the cause and the remedy."""


class UserError(Exception):
    """A mistake in input or set-up, told without a traceback by every command of ours.

    `cause` says what is wrong and where; `remedy` says what to do about it.
    """

    def __init__(self, cause: str, remedy: str) -> None:
        self.cause = cause
        self.remedy = remedy
        super().__init__(f"{cause} {remedy}")
