"""What a section says, row by row, to the process that waits for it."""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

Figures = dict[str, Any]
"""A row: numbers by name; "failed" where a check did, "left_out" and "remedy" where it was not."""


class LeftOut(Exception):
    """What cannot be asked here, and how it could be."""

    def __init__(self, why: str, remedy: str) -> None:
        self.why, self.remedy = why, remedy
        super().__init__(f"{why} {remedy}")


class SectionEnded(Exception):
    """A row failed or was left out, which has been told; the section's others are not asked."""


class Rows:
    """Sends messages, one line of JSON each: which row is begun, and what it found."""

    def __init__(self, send: Callable[[str], object]) -> None:
        self._send = send

    @contextmanager
    def row(self, name: str) -> Iterator[Figures]:
        """Give the figures to fill; they are sent at the end.

        Whatever is raised within becomes part of the row and ends the section (SectionEnded).
        """
        self._say(begin=name)
        figures: Figures = {}
        ends = True
        try:
            yield figures
            ends = False
        except LeftOut as reason:
            figures |= {"left_out": reason.why, "remedy": reason.remedy}
        # Whatever a kernel or a library may raise: the rows before it are kept.
        except Exception as error:
            figures["failed"] = f"{type(error).__name__}: {error}"[:2000]
        self._say(row=name, figures=figures)
        if ends:
            raise SectionEnded(name)

    def _say(self, **message: Any) -> None:
        self._send(json.dumps(_plain(message), allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    """What JSON can say: six digits of a number, a word for what is none."""
    if isinstance(value, dict):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else str(value)
    return value if isinstance(value, str | int | None) else str(value)


def check(figures: Figures, holds: bool, otherwise: str) -> None:
    """Mark the row as failed unless it holds; the section goes on."""
    if not holds:
        figures["failed"] = "; ".join(filter(None, (figures.get("failed"), otherwise)))
