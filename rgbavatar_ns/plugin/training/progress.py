"""How far the training is: a bar with a rate in a terminal, a line now and then in a log."""

import time
from types import TracebackType

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

_SECONDS_PER_LINE = 10.0


class TrainingProgress:
    """Shows step, loss and images per second between `start` and the last step."""

    def __init__(self, start: int, total: int, images_per_step: int) -> None:
        self._start = start
        self._total = total
        self._images_per_step = images_per_step
        self._began = self._last_line = time.monotonic()
        self._bar: Progress | None = None
        self._task = TaskID(0)
        if CONSOLE.is_terminal:
            self._bar = Progress(
                TextColumn("training"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[note]}"),
                TimeRemainingColumn(),
                console=CONSOLE,
            )

    def __enter__(self) -> "TrainingProgress":
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task(
                "training", total=self._total, completed=self._start, note=""
            )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def images_per_second(self, done: int) -> float:
        """Mean rate of this session after `done` steps in all."""
        elapsed = max(time.monotonic() - self._began, 1e-9)
        return (done - self._start) * self._images_per_step / elapsed

    def show(self, done: int, loss: float) -> None:
        """Say that `done` steps are done in all and what the last loss was."""
        note = f"loss {loss:.4f}, {self.images_per_second(done):.1f} images/s"
        if self._bar is not None:
            self._bar.update(self._task, completed=done, note=note)
            return
        now = time.monotonic()
        if now - self._last_line >= _SECONDS_PER_LINE or done in (self._start + 1, self._total):
            CONSOLE.print(f"step {done}/{self._total}: {note}", highlight=False)
            self._last_line = now
