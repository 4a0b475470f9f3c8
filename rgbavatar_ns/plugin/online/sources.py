"""Where the frames of an online run come from, by the command's flags."""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.data.importers import ImportOptions
from rgbavatar_ns.data.streams import (
    FrameStream,
    ReplayStream,
    SocketStream,
    StreamedFrame,
    StreamSubject,
)
from rgbavatar_ns.data.streams.address import DEFAULT_ADDRESS
from rgbavatar_ns.data.streams.protocol import Fault
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import FrameRate

SourceKind = Literal["replay", "folder", "socket", "video"]
_PATIENCE_S = 0.2
_SILENT_S = 1.0


@dataclass
class SourceConfig:
    """The source of a stream's frames."""

    kind: SourceKind = "replay"
    """replay: the dataset of --data in real time; socket: another program sends frames over a
    WebSocket; video: a video file, camera or network address, tracked as it comes. (folder is no
    more: its message says what to use.)"""
    frames_per_second: FrameRate = 25.0
    """Rate of a replay (paper: 25)."""
    listen: str = DEFAULT_ADDRESS
    """Where a socket waits for frames: HOST:PORT."""
    allow_remote: bool = False
    """Let a socket be reached from other machines. Nothing is encrypted, and whoever reaches it
    can send frames."""
    video: str = ""
    """A video file, the number of a camera (0), a device (/dev/video0) or an address
    (rtsp://...)."""


def open_source(
    config: SourceConfig,
    data: Path | None,
    tell: Callable[[str], None] = lambda line: None,
    importing: ImportOptions | None = None,
) -> FrameStream:
    """The stream that the flags name; raises UserError where they do not suffice.

    `tell` is called, also from threads, with what a user should read at once. `importing` says
    how `data` of another system is read.
    """
    if config.kind == "folder":
        raise UserError(
            "Frames are no longer taken from a folder into which another program writes.",
            "Send them with StreamClient and --pipeline.datamanager.source.kind socket, or write "
            "a dataset with DatasetWriter and replay it: --data FOLDER "
            "--pipeline.datamanager.source.kind replay.",
        )
    if config.kind == "socket":
        return SocketStream(config.listen, config.allow_remote, tell)
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
    if data is None:
        raise UserError(
            "No dataset was named.",
            "Pass --data FOLDER; `rgbavatar demo-data FOLDER` makes a dataset to try.",
        )
    return ReplayStream(load_dataset(data, importing), config.frames_per_second)


def await_subject(
    stream: FrameStream,
    tell: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
    left_out: Counter[str] | None = None,
) -> tuple[StreamSubject, StreamedFrame]:
    """The subject and its first usable frame, however long they take; tells what is waited for.

    Frames before it are counted in `left_out` by their reason, and the first of each is told.

    Raises:
        UserError: the stream ends before.
    """
    silent_since_s: float | None = clock()
    unused = Counter[str]() if left_out is None else left_out

    def troubles() -> str:
        found = stream.counts + unused
        listed = ", ".join(f"{name}: {count}" for name, count in found.items())
        return f" ({listed})" if listed else ""

    def go_on(what: str) -> None:
        nonlocal silent_since_s
        if stream.ended:
            raise UserError(
                f"The stream ended before {what} came{troubles()}.",
                "Check the source: nothing in it could be used.",
            )
        if silent_since_s is not None and clock() - silent_since_s > _SILENT_S:
            silent_since_s = None
            place = f" at {stream.address}" if isinstance(stream, SocketStream) else ""
            tell(f"Waiting for frames{place}{troubles()}; Ctrl-C ends.")

    while (subject := stream.subject(_PATIENCE_S)) is None:
        go_on("a subject")
    while True:
        frame = stream.next(_PATIENCE_S)
        if frame is None:
            go_on("a frame")
            continue
        fault = _fault(frame, subject)
        if fault is None:
            return subject, frame
        if not unused[fault.name]:
            tell(fault.told(frame))
        unused[fault.name] += 1


def _fault(frame: StreamedFrame, subject: StreamSubject) -> Fault | None:
    """Why a frame cannot be used, its image included; None where it can be."""
    fault = subject.fault(frame)
    if fault is not None:
        return fault
    try:
        frame.decode()
    except UserError as error:
        return Fault.unreadable(error)
    return None
