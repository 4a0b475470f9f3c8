"""Frames as time passes: a file at its own speed, a camera's latest, over lost connections."""

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from rgbavatar_ns.data.streams import Backoff
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.input.video import FrameSource

_FRAMES_PER_SECOND = 25.0
"""Of a folder of images, which has no clock."""
_TIMEOUT_MS = 5000
_LONGEST_SKIP_S = 0.1
_MOST_OF_ANOTHER_SIZE = 50
"""A source that shows so many such pictures in a row will show no others: it is told."""
Pace = Literal["each", "newest", "at once"]


@dataclass(frozen=True)
class CapturedFrame:
    """An image, its number in the source and when it was there, by time.monotonic()."""

    index: int
    image_rgb: UInt8[np.ndarray, "H W 3"]
    captured_s: float
    time_s: float | None = None
    """By the source's own clock, where it has one."""


class FileCapture:
    """Frames of a video file or a folder of images.

    pace: "each" gives every frame, none before its time; "newest" the newest that is due, and
    `captured_s` is when it was due; "at once" every frame as soon as it is asked for. Raises
    UserError where there is no file, and from `next` where it cannot be read.
    """

    keeps_frames = True

    def __init__(self, path: Path, pace: Pace = "each") -> None:
        self.counts: Counter[str] = Counter()
        self._pace: Pace = pace
        self._frames = iter(FrameSource.open(path))
        self._waiting: CapturedFrame | None = None
        self._due_s = 0.0
        self._began: tuple[float, float] | None = None  # by our clock, by the file's
        self._passed_over = -1
        self.ended = False

    def next(self, timeout_s: float) -> CapturedFrame | None:
        """The next frame, once it is due by the file's clock."""
        if self._waiting is None and not self._read():
            return None
        late_s = 0.0 if self._pace == "at once" else self._due_s - time.monotonic()
        if late_s > 0:
            time.sleep(min(late_s, timeout_s))
            if late_s > timeout_s:
                return None
        due, self._waiting = self._waiting, None
        assert due is not None
        if self._pace != "newest":
            return replace(due, captured_s=time.monotonic())
        due_s, now = self._due_s, time.monotonic()
        # A film that is read more slowly than it plays is shown late rather than not at all.
        while self._read() and self._due_s <= now and time.monotonic() < now + _LONGEST_SKIP_S:
            assert self._waiting is not None
            due, due_s, self._waiting = self._waiting, self._due_s, None
            self.counts["skipped"] += 1
        return replace(due, captured_s=due_s)

    def pass_over(self, index: int) -> None:
        """Give the frames up to this number as they are asked for; from there the file plays."""
        self._passed_over = index
        if self._waiting is not None and self._waiting.index <= index:
            self._due_s = 0.0

    def _read(self) -> bool:
        frame = None if self.ended else next(self._frames, None)
        if frame is None:
            self.ended = True
            return False
        now = time.monotonic()
        clock_s = frame.index / _FRAMES_PER_SECOND if frame.time_s is None else frame.time_s
        if self._began is None or frame.index <= self._passed_over:
            self._began = now, clock_s
        self._due_s = self._began[0] + clock_s - self._began[1]
        self._waiting = CapturedFrame(frame.index, frame.image_rgb, now, clock_s)
        return True

    def close(self) -> None:
        """Read no further."""
        self.ended = True


def is_device(source: str) -> bool:
    """Whether this names a camera by its number, a device or a network address, and no file.

    A file or folder whose name is a number is one: cameras beyond the tenth are rare.
    """
    if source.isdecimal():
        return len(source) == 1 or not Path(source).exists()
    return is_address(source) or source.startswith("/dev/")


def is_address(source: str) -> bool:
    """Whether this names what a network or a server shows: rtsp://..., http://..."""
    return "://" in source


def open_capture(source: str) -> cv2.VideoCapture:
    """A camera by its number, a device or a network address."""
    if source.isdecimal():
        return cv2.VideoCapture(int(source))
    timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT_MS]
    timeouts += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT_MS]
    if source.startswith("/dev/"):
        return cv2.VideoCapture(source)
    return cv2.VideoCapture(source, cv2.CAP_FFMPEG, timeouts)


class LatestFrameCapture:
    """The latest frame of a camera, read in a thread of its own; what is older is skipped.

    Where the camera is lost it is opened again, with growing pauses, for ever. `counts` says how
    many frames were "skipped", and how often there was "source lost", "failed openings" and
    "reconnects".
    """

    keeps_frames = False
    ended = False

    def __init__(
        self,
        source: str,
        opener: Callable[[str], cv2.VideoCapture] = open_capture,
        backoff: Backoff | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._source, self._open = source, opener
        self._backoff = backoff or Backoff()
        self._latest: CapturedFrame | None = None
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._grab, name="rgbavatar camera", daemon=True)
        self._thread.start()

    def next(self, timeout_s: float) -> CapturedFrame | None:
        """The latest frame that has not been given yet; None if none comes in `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: self._latest is not None or self.ended, timeout_s)
            latest, self._latest = self._latest, None
            return latest

    def close(self) -> None:
        """Let go of the camera."""
        self._closed.set()
        with self._changed:
            self.ended = True
            self._changed.notify_all()
        self._thread.join(timeout=2 * _TIMEOUT_MS / 1000)

    def _grab(self) -> None:
        index, had_one = 0, False
        while not self._closed.is_set():
            capture = self._open(self._source)
            try:
                if not capture.isOpened():
                    self.counts["failed openings"] += 1
                elif had_one:
                    self.counts["reconnects"] += 1
                while capture.isOpened() and not self._closed.is_set():
                    came, image_bgr = capture.read()
                    if not came or image_bgr is None:
                        break
                    image_rgb = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2RGB)
                    self._put(CapturedFrame(index, image_rgb, time.monotonic()))
                    self._backoff.reset()
                    index, had_one = index + 1, True
                else:
                    continue
                self.counts["source lost"] += 1
            finally:
                capture.release()
                if not self._closed.is_set():
                    self._closed.wait(self._backoff.pause_s())

    def _put(self, frame: CapturedFrame) -> None:
        with self._changed:
            if self._latest is not None:
                self.counts["skipped"] += 1
            self._latest = frame
            self._changed.notify_all()


FrameCapture = FileCapture | LatestFrameCapture


class OneSize:
    """Holds a stream to the size of its first picture, since all its frames share a camera.

    Called with each picture, it tells whether that has this size; `counts` counts those of
    "another resolution". Raises UserError where a camera stays with another size.
    """

    def __init__(self, counts: Counter[str]) -> None:
        self._counts, self._others = counts, 0
        self._first: tuple[int, int] | None = None

    def __call__(self, image_rgb: UInt8[np.ndarray, "H W 3"]) -> bool:
        """Whether the picture may be tracked."""
        high, wide = image_rgb.shape[:2]
        self._first = self._first or (wide, high)
        if self._first == (wide, high):
            self._others = 0
            return True
        self._counts["another resolution"] += 1
        self._others += 1
        if self._others == _MOST_OF_ANOTHER_SIZE:
            raise UserError(
                f"The camera's pictures have changed from {self._first[0]} x {self._first[1]} to "
                f"{wide} x {high} pixels.",
                "Set the camera to its first size again, or start anew: a run has one camera.",
            )
        return False
