"""One form of progress bar for all commands."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar; the value given is a function of (done, total) that moves it."""
    with stage_bars() as update:
        yield lambda done, total: update(title, done, total)


@contextmanager
def stage_bars(unit: str = "") -> Iterator[Callable[[str, int, int | None], None]]:
    """Show a bar for each stage of a command, with its rate and time left.

    The value given is a function of (stage, done, total) that moves the stage's bar and makes it
    at the stage's first call; total None is not known. `unit` is what is counted ("frames").
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(f"{unit} {{task.fields[rate]}}".strip()),
        TimeRemainingColumn(),
    )
    tasks: dict[str, TaskID] = {}
    starts: dict[str, tuple[float, int]] = {}
    with Progress(*columns) as bars:

        def update(stage: str, done: int, total: int | None) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=None, rate="", completed=done)
                starts[stage] = (time.monotonic(), done)
            began, first = starts[stage]
            elapsed = time.monotonic() - began
            rate = f"{(done - first) / elapsed:.1f}/s" if elapsed > 0.5 else ""
            bars.update(tasks[stage], completed=done, total=total, rate=rate)

        yield update
