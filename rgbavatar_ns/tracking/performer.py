"""A person before a camera, or in a video, as a performance that drives an avatar."""

import glob
import time
from collections import deque
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.data.streams.address import told_address
from rgbavatar_ns.drawing.contact_sheet import scaled
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.tracking.input.capture import (
    CapturedFrame,
    FileCapture,
    FrameCapture,
    LatestFrameCapture,
    is_address,
    is_device,
    open_capture,
)
from rgbavatar_ns.tracking.tracked_capture import TrackedCapture

_FIRST_PICTURE_S = 10.0
"""A camera that has shown nothing for so long will show nothing: it is told."""
_SILENT_S = 3.0
"""A camera that showed pictures and shows none for so long has gone."""


class FilmedPerformer(TrackedCapture):
    """Tracks the newest picture of a camera, or those of a file, and gives the head's theta.

    The first dozen pictures with a face give the person, which takes two seconds; what comes
    meanwhile is skipped. `tracker` serves in place of a `LiveTracker`, `capture` in place of what
    `source` names: a camera's number, a device, a network address, a video file or a folder of
    images. Of a file in real time only what is due is tracked, else every frame. Raises UserError
    where the camera cannot be opened or shows nothing, and where the file cannot be read.
    image_height_px: of the pictures that frames bring along; without it they bring none.
    """

    def __init__(
        self,
        source: str,
        real_time: bool = True,
        image_height_px: int | None = None,
        tracker: Any = None,
        capture: FrameCapture | None = None,
    ) -> None:
        super().__init__(_open(source, real_time) if capture is None else capture, tracker)
        self._told, self._is_address = told_address(source), is_address(source)
        self.head = PerformerHead(self._tracker.head.layout, self._tracker.head.arrays)
        self._image_height_px = image_height_px
        self._keeps_all = not real_time
        self._unmet: dict[int, CapturedFrame] = {}
        self._backlog: deque[PerformanceFrame] = deque()
        self._began_s = time.monotonic()
        self._shown_s: float | None = None

    @property
    def ended(self) -> bool:
        """Whether the file is at its end."""
        return self._capture.ended and not self._backlog

    @property
    def waits_for(self) -> str:
        """A picture, or a face in it; who is recorded is asked for nothing."""
        if self._shown_s is None:
            return f"the first picture of {self._told}"
        met = self._tracker.ready
        face = f"a face in {self._told} to be {'found again' if met else 'met'}"
        # A film waits for its next frame as long as that asks for.
        if self._capture.keeps_frames:
            what = "pictures without one are passed over" if met else "a dozen give the person"
            return f"{face}: {what}"
        if time.monotonic() - self._shown_s > _SILENT_S:
            return f"pictures of {self._told} to come again: is it still connected?"
        return f"{face}: look at the camera, well lit and near"

    def next(self, timeout_s: float) -> PerformanceFrame | None:
        """The head in the newest picture; tracking one may take longer than `timeout_s`."""
        if self._backlog:
            return self._backlog.popleft()
        captured = self._capture.next(timeout_s)
        if captured is None:
            self._require_pictures()
            return None
        self._shown_s = time.monotonic()
        met, faceless = self._tracker.ready, self._tracker.counts["no face"]
        if not self._of_one_size(captured.image_rgb):
            return None
        theta = self._tracker.pose(captured.image_rgb, captured.index)
        self._shown_s = time.monotonic()  # Meeting a person has taken seconds of silence.
        if not met:
            self._meet(captured, self._tracker.counts["no face"] == faceless)
            return self._backlog.popleft() if self._backlog else None
        return None if theta is None else self._performed(captured, theta)

    def _meet(self, captured: CapturedFrame, has_face: bool) -> None:
        """Keep a recording's first faces until the person is known; a camera's would be late."""
        if self._keeps_all and has_face:
            self._unmet[captured.index] = captured
        if not self._tracker.ready:
            return
        posed = self._tracker.pose_backlog()
        if self._keeps_all:
            for index, theta in posed:
                self._backlog.append(self._performed(self._unmet[index], theta))
        self._unmet.clear()

    def _performed(self, captured: CapturedFrame, theta: Float[Tensor, "H"]) -> PerformanceFrame:
        clock_s = captured.captured_s if captured.time_s is None else captured.time_s
        image_rgb = None
        if self._image_height_px is not None:
            # Now: a film's beginning is kept for seconds, whose whole pictures may be gigabytes.
            zoom = self._image_height_px / len(captured.image_rgb)
            image_rgb = scaled(captured.image_rgb, zoom)
        return PerformanceFrame(
            captured.index, captured.captured_s, clock_s, theta=theta, image_rgb=image_rgb
        )

    def _require_pictures(self) -> None:
        silent_s = time.monotonic() - self._began_s
        if self._shown_s is not None or self.ended or silent_s <= _FIRST_PICTURE_S:
            return
        if self._is_address:
            raise UserError(
                f"No picture has come from {self._told} for {silent_s:.0f} seconds.",
                _REMEDY_OF_ADDRESS,
            )
        raise UserError(f"{self._told} has shown no picture for {silent_s:.0f} seconds.", _REMEDY)


_REMEDY = (
    "Close the program that uses the camera, choose another one with --source NUMBER, or give a "
    "video file."
)
_REMEDY_OF_ADDRESS = (
    "Start the camera or server, and look at host, port and path, and at user and password "
    "(rtsp://USER:PASSWORD@HOST:PORT/PATH). `ffplay ADDRESS` tells whether it can be seen at all."
)


def _open(source: str, real_time: bool) -> FrameCapture:
    if not is_device(source):
        return FileCapture(Path(source), "newest" if real_time else "at once")
    # The capture would try for ever, as a stream has to; who starts a camera is told at once.
    tried = open_capture(source)
    opened = tried.isOpened()
    tried.release()
    if not opened and is_address(source):
        raise UserError(
            f"{told_address(source)} cannot be opened: nothing answers there, or nothing that is a "
            "video.",
            _REMEDY_OF_ADDRESS,
        )
    if not opened:
        there = sorted(glob.glob("/dev/video*"))
        known = f" There are {first_few(there, 4)}." if there else " No camera is there."
        which = f"Camera {source}" if source.isdecimal() else told_address(source)
        raise UserError(
            f"{which} cannot be opened: it is not there, or another program has it.{known}", _REMEDY
        )
    return LatestFrameCapture(source)
