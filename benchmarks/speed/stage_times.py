"""How long each stage of tracking takes, from the calls that tell its progress."""

import time
from dataclasses import dataclass, field


@dataclass
class StageTimes:
    """Seconds of each stage; what passed since the call before is the stage's that calls.

    `silent_s` is the longest time between two calls.
    """

    clock_s: dict[str, float] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)
    silent_s: dict[str, float] = field(default_factory=dict)
    span_s: dict[str, list[float]] = field(default_factory=dict)
    """First and last moment of each stage, as `time.monotonic` has them."""
    _last: tuple[float, float] = field(
        default_factory=lambda: (time.monotonic(), time.process_time())
    )

    def __call__(self, stage: str, _done: int, _total: int | None) -> None:
        """Told of progress."""
        now, used = time.monotonic(), time.process_time()
        clock_s, cpu_s = now - self._last[0], used - self._last[1]
        self.clock_s[stage] = self.clock_s.get(stage, 0.0) + clock_s
        self.cpu_s[stage] = self.cpu_s.get(stage, 0.0) + cpu_s
        self.silent_s[stage] = max(self.silent_s.get(stage, 0.0), clock_s)
        self.span_s.setdefault(stage, [self._last[0], now])[1] = now
        self._last = now, used
