"""How far the training is: a bar with a rate in a terminal, a line now and then in a log."""

import time

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rgbavatar_ns.plugin.console import say

_SECONDS_PER_LINE = 10.0


class TrainingProgress(Progress):
    """Shows step, loss and images per second between `start` and the last step.

    Where a run is given seconds, `most_seconds`, also how many of them are used.
    """

    def __init__(
        self, start: int, total: int, images_per_step: int, most_seconds: float | None = None
    ) -> None:
        super().__init__(
            TextColumn("training"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeRemainingColumn(),
            console=CONSOLE,
            disable=not CONSOLE.is_terminal,
        )
        self._first, self._total, self._images_per_step = start, total, images_per_step
        self._most_seconds = most_seconds
        self._began = self._last_line = time.monotonic()
        self._steps = self.add_task("training", total=total, completed=start, note="")

    def show(self, done: int, loss: float, seconds: float) -> None:
        """Say that `done` steps are done in all, in so many seconds, and what the last loss was."""
        now = time.monotonic()
        images = (done - self._first) * self._images_per_step
        note = f"loss {loss:.4f}, {images / max(now - self._began, 1e-9):.1f} images/s"
        if self._most_seconds is not None:
            note += f", {seconds:.0f} of {self._most_seconds:.0f} s"
        if not self.disable:
            self.update(self._steps, completed=done, note=note)
        elif now - self._last_line >= _SECONDS_PER_LINE or done in (self._first + 1, self._total):
            say(f"step {done}/{self._total}: {note}")
            self._last_line = now
