"""What is odd in a source: frames that cannot be used, counted and named in one report."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rgbavatar_ns.errors import UserError, first_few

_SHOWN = 4


class UnusableFrameError(Exception):
    """One frame cannot be used; the text says why, in words that hold for others like it."""


class ImportReport:
    """Collects frames that are left out, by reason, and notes on what was done."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self._left_out: dict[str, list[str]] = {}

    def note(self, text: str) -> None:
        """Something that the user should know, said once."""
        if text not in self.notes:
            self.notes.append(text)

    def leave_out(self, reason: str, names: Sequence[str]) -> None:
        """Frames of these names cannot be used."""
        if names:
            self._left_out.setdefault(reason, []).extend(names)

    def left_out(self, reason: str) -> int:
        """How many frames were left out for this reason since `settle` noted them."""
        return len(self._left_out.get(reason, ()))

    @contextmanager
    def frame(self, name: str) -> Iterator[None]:
        """An UnusableFrameError within goes into the report under this name."""
        try:
            yield
        except UnusableFrameError as error:
            self.leave_out(str(error), [name])

    def settle(self, what: str, allow_partial: bool) -> None:
        """Raise UserError about all frames left out since, or note them where that is allowed."""
        if not self._left_out:
            return
        told = "; ".join(
            f"{reason}: {len(names)} ({first_few(names, _SHOWN)})"
            for reason, names in self._left_out.items()
        )
        if not allow_partial:
            raise UserError(
                f"{what} has frames that cannot be used: {told}.",
                "Mend them, or leave them out with --allow-partial.",
            )
        self.note(f"left out: {told}")
        self._left_out = {}
