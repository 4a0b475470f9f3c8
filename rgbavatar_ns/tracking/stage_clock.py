"""What a long run is at, and how long each of its stages took."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

Progress = Callable[[str, int, int | None], None]
"""Called with (stage, frames done, frames in all); None where a file does not say how many."""


@dataclass
class StageClock:
    """Tells the progress of one stage after the other, and how long each one took.

    A stage's first report says how many of its frames were done in an earlier run.
    """

    progress: Progress | None
    stages: dict[str, dict[str, float | int]] = field(default_factory=dict)
    """Of each stage the frames done in this run, seconds, and frames a second."""
    _name: str = ""
    _total: int | None = None
    _first: int | None = None
    _now: int = 0
    _began: float = 0.0

    def begin(self, name: str, total: int | None) -> None:
        """End the stage before."""
        self.end()
        self._name, self._total, self._first = name, total, None
        self._began = time.perf_counter()

    def done(self, frames: int) -> None:
        """So many of the stage's frames are done."""
        self._now = frames
        self._first = frames if self._first is None else self._first
        if self.progress is not None:
            total = None if self._total is None else max(self._total, frames)
            self.progress(self._name, frames, total)

    def end(self) -> None:
        """Note down the stage's time."""
        if self._name:
            seconds = time.perf_counter() - self._began
            frames = self._now - (self._first or 0)
            self.stages[self._name] = {
                "frames": frames,
                "seconds": seconds,
                "frames_per_second": frames / seconds,
            }
            if self.progress is not None:
                self.progress(self._name, self._now, self._now)
        self._name = ""

    def frames_per_second(self, frames: int) -> float | None:
        """Of the whole run; None where some of it was done in an earlier run."""
        if not all(stage["frames"] for stage in self.stages.values()):
            return None
        return frames / sum(stage["seconds"] for stage in self.stages.values())
