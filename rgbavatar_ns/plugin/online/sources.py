"""Where the frames of an online run come from, by the command's flags."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.data.streams import (
    FolderStream,
    FrameStream,
    PushedStream,
    ReplayStream,
    StreamedFrame,
    StreamSubject,
)
from rgbavatar_ns.data.streams.address import DEFAULT_ADDRESS
from rgbavatar_ns.errors import UserError

SourceKind = Literal["replay", "folder", "socket", "video"]
_PATIENCE_S = 0.2
_SILENT_S = 1.0


@dataclass
class SourceConfig:
    """The source of a stream's frames."""

    kind: SourceKind = "replay"
    """replay: the dataset of --data in real time; folder: the folder of --data, into which
    another program writes records; socket: another program pushes records; video: a video file,
    camera or network address, tracked as it comes."""
    frames_per_second: float = 25.0
    """Rate of a replay (paper: 25)."""
    listen: str = DEFAULT_ADDRESS
    """Where a socket waits for frames: HOST:PORT, or unix:PATH."""
    allow_remote: bool = False
    """Let a socket be reached from other machines. Nothing is encrypted, and whoever reaches it
    can send frames."""
    video: str = ""
    """A video file, the number of a camera (0), a device (/dev/video0) or an address
    (rtsp://...)."""


def open_source(config: SourceConfig, data: Path | None) -> FrameStream:
    """The stream that the flags name; raises UserError where they do not suffice."""
    if config.kind == "socket":
        return PushedStream(config.listen, config.allow_remote)
    if config.kind == "video":
        if not config.video:
            raise UserError(
                "No video was named.",
                "Pass --pipeline.datamanager.source.video with a file, a camera's number or an "
                "address.",
            )
        # Its models take a second to import, which the other sources need not wait for.
        from rgbavatar_ns.tracking.video_stream import VideoStream

        return VideoStream(config.video)
    if data is None or data == Path():
        raise UserError(
            "No dataset was named." if config.kind == "replay" else "No folder was named.",
            "Pass --data FOLDER; `rgbavatar demo-data FOLDER` makes a dataset to try.",
        )
    if config.kind == "folder":
        return FolderStream(data)
    return ReplayStream(load_dataset(data), config.frames_per_second)


def await_subject(
    stream: FrameStream, tell: Callable[[str], None]
) -> tuple[StreamSubject, StreamedFrame]:
    """The subject and its first usable frame, however long they take; tells what is waited for.

    Raises:
        UserError: the stream ends before.
    """
    waiting = _Waiting(tell, _place(stream))
    subject = stream.subject(_PATIENCE_S)
    while subject is None:
        waiting.go_on(stream, "a subject")
        subject = stream.subject(_PATIENCE_S)
    while True:
        frame = stream.next(_PATIENCE_S)
        if frame is None:
            waiting.go_on(stream, "a frame")
        elif _usable(frame, subject):
            return subject, frame


def _usable(frame: StreamedFrame, subject: StreamSubject) -> bool:
    fits = frame.theta.shape == (subject.layout.size,) and bool(frame.theta.isfinite().all())
    if not fits:
        return False
    try:
        height, width = frame.decode().image_rgba.shape[:2]
    except UserError:
        return False
    return (width, height) == (subject.width, subject.height)


class _Waiting:
    """Says once what is waited for, if that takes long."""

    def __init__(self, tell: Callable[[str], None], place: str) -> None:
        self._tell, self._place = tell, place
        self._since_s: float | None = time.monotonic()

    def go_on(self, stream: FrameStream, what: str) -> None:
        if stream.ended:
            raise UserError(
                f"The stream ended before {what} came.",
                "Check the source: nothing in it could be used.",
            )
        if self._since_s is not None and time.monotonic() - self._since_s > _SILENT_S:
            self._since_s = None
            troubles = ", ".join(f"{name}: {count}" for name, count in (+stream.counts).items())
            told = f" ({troubles})" if troubles else ""
            self._tell(f"Waiting for frames{self._place}{told}; Ctrl-C ends.")


def _place(stream: FrameStream) -> str:
    return f" at {stream.address}" if isinstance(stream, PushedStream) else ""
