"""A recorded performance, played at its own speed or frame after frame."""

import time
from collections import Counter
from collections.abc import Callable, Sequence

from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead

MakeFrame = Callable[[int, float], PerformanceFrame]
"""The frame of a place in the recording, and when it was captured."""


class RecordedSource:
    """Frames of a recording: in real time the newest one that is due, else each of them.

    times_s: of each frame, rising. waits_for: as `PerformanceSource`.
    """

    def __init__(
        self,
        times_s: Sequence[float],
        frame: MakeFrame,
        head: PerformerHead | None,
        real_time: bool = True,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.head, self.counts, self.waits_for = head, Counter[str](), "the recording"
        self._times_s, self._frame, self._real_time = times_s, frame, real_time
        self._clock, self._sleep = clock, sleep
        self._next, self._began_s = 0, None if real_time else 0.0

    @property
    def ended(self) -> bool:
        """Whether the last frame has been given."""
        return self._next >= len(self._times_s)

    def next(self, timeout_s: float) -> PerformanceFrame | None:
        """The next frame, or in real time the newest that is due; what is older is skipped."""
        if self.ended:
            return None
        if not self._real_time:
            return self._given(self._next, self._clock())
        if self._began_s is None:
            self._began_s = self._clock() - self._times_s[0]
        late_s = self._clock() - self._began_s - self._times_s[self._next]
        if late_s < 0:
            self._sleep(min(-late_s, timeout_s))
            if -late_s > timeout_s:
                return None
        now_s = self._clock() - self._began_s
        place = self._next
        while place + 1 < len(self._times_s) and self._times_s[place + 1] <= now_s:
            place += 1
        self.counts["skipped"] += place - self._next
        return self._given(place, self._began_s + self._times_s[place])

    def _given(self, place: int, captured_s: float) -> PerformanceFrame:
        self._next = place + 1
        return self._frame(place, captured_s)

    def close(self) -> None:
        """Give no more."""
        self._next = len(self._times_s)
