"""From a performance to whatever shows the avatar, as it happens; how late it is."""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.driving.source import PerformanceFrame, PerformanceSource

_PATIENCE_S = 0.2
_SILENT_S = 1.5
"""After so long without a frame it is told what is waited for."""
_TOLD_EVERY_S = 1.0
_WAITING = 4
"""Frames of a recording that are tracked while others are drawn."""
_SAME_MOMENT_S = 1e-6
"""Sums of frames' times differ by less from what they should be."""
_KEPT = 3000
"""Latencies that are kept: two minutes."""


@dataclass(frozen=True)
class DrivenFrame:
    """The avatar's theta for one frame of the performance."""

    index: int
    theta: Float[Tensor, "H"]
    captured_s: float
    """When the performer's picture or packet was there, by time.monotonic()."""
    time_s: float
    """By the source's own clock."""
    image_rgb: UInt8[np.ndarray, "height width 3"] | None = None
    """The performer's picture, where there is one, as high as the pictures beside which it is."""


class Latencies:
    """Seconds from a performer's picture to the avatar's, of the last two minutes."""

    def __init__(self) -> None:
        self._seconds: deque[float] = deque(maxlen=_KEPT)
        self._shown_s: deque[float] = deque(maxlen=_KEPT)
        self.shown = 0

    def add(self, captured_s: float, shown_s: float) -> None:
        """One picture was captured and shown at these times."""
        self._seconds.append(shown_s - captured_s)
        self._shown_s.append(shown_s)
        self.shown += 1

    def quantile_s(self, share: float) -> float:
        """The latency that so large a share of the pictures does not exceed."""
        return float(np.quantile(list(self._seconds), share)) if self._seconds else 0.0

    def frames_per_second(self) -> float:
        """Pictures a second over what is kept."""
        times = list(self._shown_s)
        lasted_s = times[-1] - times[0] if len(times) > 1 else 0.0
        return (len(times) - 1) / lasted_s if lasted_s > 0 else 0.0

    def __str__(self) -> str:
        """For the user."""
        return (
            f"{self.frames_per_second():.0f} pictures/s, "
            f"{1e3 * self.quantile_s(0.5):.0f} ms from picture to picture "
            f"(95 %: {1e3 * self.quantile_s(0.95):.0f})"
        )


@runtime_checkable
class DriveOutput(Protocol):
    """What shows the avatar."""

    latencies: Latencies

    def show(self, frame: DrivenFrame) -> None:
        """Draw or pass on one frame; its latency counts once it can be seen."""
        ...

    def tell(self, line: str) -> None:
        """Show how it goes, where there is a place for it."""
        ...

    def close(self) -> None:
        """Complete what was begun."""
        ...


@runtime_checkable
class FrameTransfer(Protocol):
    """What makes the avatar's theta of a frame (`LiveTransfer`)."""

    @property
    def calibrating(self) -> bool:
        """Whether the performer's rest is being learnt."""
        ...

    def calibrate(self) -> None:
        """Learn it anew."""
        ...

    def learn(self, frame: PerformanceFrame) -> None:
        """Learn from a frame ahead of its turn."""
        ...

    def conclude(self) -> None:
        """Learn no more: what is known so far counts."""
        ...

    def __call__(self, frame: PerformanceFrame) -> Float[Tensor, "H"]:
        """The avatar's theta."""
        ...


@contextlib.contextmanager
def _closed_after(one: PerformanceSource | DriveOutput) -> Iterator[None]:
    """Close it at the end; an error under way goes before what closing has to say."""
    failed = False
    try:
        yield
    except Exception:
        failed = True
        raise
    finally:
        with contextlib.suppress(Exception) if failed else contextlib.nullcontext():
            one.close()


class LiveDrive:
    """Follows a source in a thread of its own and shows each frame from the caller's.

    real_time: the newest frame is shown and older ones are skipped; otherwise each one is.
    tell: is called with what a user should read, at most once a second. seconds: of the
    performance by the source's own clock, from the first frame that comes; without, all is shown.
    """

    def __init__(
        self,
        source: PerformanceSource,
        transfer: FrameTransfer,
        outputs: Sequence[DriveOutput],
        real_time: bool = True,
        tell: Callable[[str], None] = lambda line: None,
        seconds: float | None = None,
    ) -> None:
        self._source, self._transfer, self._outputs = source, transfer, outputs
        self._tell, self._seconds = tell, seconds
        self._began_s: float | None = None
        self._learning_ahead = False
        self._waiting: deque[DrivenFrame] = deque(maxlen=1 if real_time else None)
        self._room = 1 if real_time else _WAITING
        self._real_time = real_time
        self._changed = threading.Condition()
        self._stopped = self._followed = self._asked = False
        self._trouble: BaseException | None = None
        self.not_drawn = 0
        self.shown = 0

    def calibrate(self) -> None:
        """Learn the performer's rest anew; may be called from any thread."""
        self._asked = True

    def stop(self) -> None:
        """End `run` soon; may be called from any thread."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def run(self) -> None:
        """Show the performance until its end, `stop`, or Ctrl-C; raises what the source raised."""
        follower = threading.Thread(target=self._follow, name="rgbavatar performer", daemon=True)
        follower.start()
        with contextlib.ExitStack() as closing:
            for one in (self._source, *self._outputs):
                closing.enter_context(_closed_after(one))
            try:
                self._show_performance()
            finally:
                self.stop()
                follower.join(timeout=10.0)
            if self._trouble is not None:
                raise self._trouble

    def _show_performance(self) -> None:
        """Until it is over; tells how it goes."""
        silent_since_s = told_s = time.monotonic()
        while (frame := self._next()) is not None or not self._over():
            now_s = time.monotonic()
            if frame is not None:
                silent_since_s = now_s
                for output in self._outputs:
                    output.show(frame)
                self.shown += 1
            if time.monotonic() - told_s > _TOLD_EVERY_S:
                told_s = time.monotonic()
                line = self._told(told_s - silent_since_s)
                self._tell(line)
                for output in self._outputs:
                    output.tell(line)

    def _told(self, silent_s: float) -> str:
        if silent_s > _SILENT_S and not self._learning_ahead:
            return f"Waiting for {self._source.waits_for}; Ctrl-C ends."
        told = [str(one.latencies) for one in self._outputs if one.latencies.shown]
        told += ["learning the neutral face"] if self._transfer.calibrating else []
        return "; ".join([f"{self.shown} frames", *told])

    def _next(self) -> DrivenFrame | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._over(), _PATIENCE_S)
            frame = self._waiting.popleft() if self._waiting and not self._stopped else None
            self._changed.notify_all()
            return frame

    def _over(self) -> bool:
        return self._stopped or (self._followed and not self._waiting)

    def _follow(self) -> None:
        """Take frames from the source as theta, until it ends.

        A film's beginning waits until the performer's rest is known from it.
        """
        ahead: list[PerformanceFrame] = []
        try:
            while not (self._stopped or self._source.ended):
                performed = self._source.next(_PATIENCE_S)
                if performed is None:
                    continue
                if self._is_past(performed):
                    break
                if self._asked:
                    self._asked = False
                    self._transfer.calibrate()
                if not self._real_time and self._transfer.calibrating and self.shown == 0:
                    self._transfer.learn(performed)
                    ahead.append(performed)
                    self._learning_ahead = True
                    continue
                self._learning_ahead = False
                self._show_all([*ahead, performed])
                ahead.clear()
            if ahead:
                self._transfer.conclude()
                self._show_all(ahead)
        except BaseException as error:
            self._trouble = error
        finally:
            with self._changed:
                self._followed = True
                self._changed.notify_all()

    def _is_past(self, performed: PerformanceFrame) -> bool:
        """Whether the frame comes after the seconds that are asked for."""
        if self._seconds is None:
            return False
        if self._began_s is None:
            self._began_s = performed.time_s
        return performed.time_s - self._began_s > self._seconds - _SAME_MOMENT_S

    def _show_all(self, performed: Sequence[PerformanceFrame]) -> None:
        for one in performed:
            theta = self._transfer(one)
            self._put(DrivenFrame(one.index, theta, one.captured_s, one.time_s, one.image_rgb))

    def _put(self, frame: DrivenFrame) -> None:
        with self._changed:
            if not self._real_time:
                self._changed.wait_for(lambda: len(self._waiting) < self._room or self._stopped)
            elif self._waiting:
                self.not_drawn += 1
            self._waiting.append(frame)
            self._changed.notify_all()
