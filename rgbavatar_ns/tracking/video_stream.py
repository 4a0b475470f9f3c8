"""A video, camera or network address as a stream of tracked frames."""

import secrets
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rgbavatar_ns.data import TrackedFrame
from rgbavatar_ns.data.streams import StreamedFrame, StreamSubject
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.input.capture import (
    FileCapture,
    FrameCapture,
    LatestFrameCapture,
    is_device,
)
from rgbavatar_ns.tracking.input.image_files import source_digest
from rgbavatar_ns.tracking.tracked_capture import TrackedCapture


class VideoStream(TrackedCapture):
    """Tracks frames as they come; the tracker's first ones give the subject.

    A file or a folder of images is tracked frame by frame, no faster than it plays. Of a camera
    (its number), a device or a network address the latest frame is tracked, and what came
    meanwhile is skipped; where it is lost it is connected again.

    `image_size` is the side of the tracked frames' images in pixels. `tracker` serves in place of a
    `LiveTracker`, `capture` in place of what `source` names.
    """

    def __init__(
        self,
        source: str,
        image_size: int = 256,
        tracker: Any = None,
        capture: FrameCapture | None = None,
    ) -> None:
        config = TrackConfig(image_size=image_size)
        super().__init__(_open(source) if capture is None else capture, tracker, config)
        self.keeps_frames = self._capture.keeps_frames
        # A file's frames have the same numbers in the next run, a camera's begin anew.
        self._session = _session_of(source) if self.keeps_frames else secrets.token_hex(8)
        self._subject: StreamSubject | None = None
        self._ready: deque[StreamedFrame] = deque()
        self._passed_over = -1

    @property
    def ended(self) -> bool:
        """Whether the file is at its end and every frame has been given."""
        return self._closed or (self._capture.ended and not self._ready)

    def subject(self, timeout_s: float) -> StreamSubject | None:
        """The person, once enough frames have shown the face."""
        self._track_until(lambda: self._subject is not None or self._capture.ended, timeout_s)
        return self._subject

    def next(self, timeout_s: float) -> StreamedFrame | None:
        """The next tracked frame; tracking one may take longer than `timeout_s`."""
        self._track_until(lambda: bool(self._ready) or self.ended, timeout_s)
        return self._ready.popleft() if self._ready and not self._closed else None

    def go_on_after(self, index: int) -> None:
        """Pass over a file's frames up to this number; a camera shows what is now."""
        if isinstance(self._capture, FileCapture):
            self._passed_over = index
            self._capture.pass_over(index)
            self._ready = deque(frame for frame in self._ready if frame.index > index)

    def _track_until(self, done: Callable[[], bool], timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while not done() and (left := deadline - time.monotonic()) > 0:
            self._track(left)

    def _track(self, timeout_s: float) -> None:
        """Track the next frame, if one comes in time."""
        captured = self._capture.next(timeout_s)
        if captured is None or (self._tracker.ready and captured.index <= self._passed_over):
            return
        if not self._of_one_size(captured.image_rgb):
            return
        frame = self._tracker(captured.image_rgb, captured.index)
        if self._subject is None and self._tracker.ready:
            backlog = self._tracker.backlog()
            self._subject = self._met(backlog)
            for one in backlog:
                self._give(one, captured.captured_s)
        if frame is not None:
            self._give(frame, captured.captured_s)

    def _met(self, backlog: list[TrackedFrame]) -> StreamSubject:
        if not backlog:
            raise UserError(
                "The tracker met a face, but could fit the head to none of its first images.",
                "Begin with the face seen from the front, well lit and near the camera.",
            )
        height, width = backlog[0].image_rgba.shape[:2]
        head = self._tracker.head
        return StreamSubject(
            head.arrays, self._tracker.identity, head.layout, width, height, self._session
        )

    def _give(self, frame: TrackedFrame, captured_s: float) -> None:
        if frame.index > self._passed_over:
            self._ready.append(
                StreamedFrame(
                    frame.index,
                    frame.theta,
                    frame.camera,
                    captured_s,
                    self._session,
                    image_rgba=frame.image_rgba,
                )
            )


def _session_of(source: str) -> str:
    """The same whenever this file or folder is read, and another for another."""
    return source_digest(Path(source))[:16] if Path(source).exists() else ""


def _open(source: str) -> FrameCapture:
    if is_device(source):
        return LatestFrameCapture(source)
    return FileCapture(Path(source))
