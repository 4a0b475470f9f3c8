"""A folder into which a tracker is writing, as a stream; and its writer."""

import os
import re
import time
from collections import Counter, deque
from pathlib import Path

from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.streams import message_format as wire
from rgbavatar_ns.data.streams.protocol import StreamedFrame, StreamSubject
from rgbavatar_ns.data.streams.sequence_numbers import SeenNumbers
from rgbavatar_ns.errors import UserError

SUBJECT_FILE = "subject.rga"
END_FILE = "end.rga"
_FRAME_FILE = re.compile(r"frame-(\d+)\.rga")
_SHORTEST_PAUSE_S = 0.01
_PAUSE_PER_LISTING = 4.0
"""Listing a large folder takes long; so much longer nothing is listed."""


class FolderWriter:
    """Writes a stream's records as files, each of them whole or not there.

    `subject.rga` comes first, `frame-0000000012.rga` for each frame, `end.rga` from `end`. The
    folder is made where it is missing; raises UserError where there is a stream in it already.
    """

    def __init__(self, folder: str | Path, subject: StreamSubject) -> None:
        self._folder = Path(folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        if (self._folder / SUBJECT_FILE).exists():
            raise UserError(f"{folder} holds a stream already.", "Name a new folder.")
        self._write(SUBJECT_FILE, wire.subject_record(subject))

    def send(self, frame: TrackedFrame) -> None:
        """Write one frame."""
        self._write(f"frame-{frame.index:010d}.rga", wire.frame_record(frame))

    def end(self) -> None:
        """Say that no frame follows."""
        self._write(END_FILE, wire.end_record())

    def _write(self, name: str, data: bytes) -> None:
        partial = self._folder / f".{name}.partial"
        partial.write_bytes(data)
        os.replace(partial, self._folder / name)


class FolderStream:
    """The frames of a folder by their numbers, as they appear; the files stay.

    A missing folder is waited for, as are the files of one that has gone for a while.
    """

    keeps_frames = True

    def __init__(self, folder: str | Path) -> None:
        self.counts: Counter[str] = Counter()
        self._folder = Path(folder)
        self._subject: StreamSubject | None = None
        self._seen = SeenNumbers()
        self._found: deque[int] = deque()
        self._next_listing_s = 0.0
        self._end_seen = self._closed = self._reachable = False

    @property
    def ended(self) -> bool:
        """Whether `end.rga` is there and every frame has been given."""
        return self._closed or (self._end_seen and not self._found)

    def subject(self, timeout_s: float) -> StreamSubject | None:
        """The folder's subject, once its file is there; raises UserError if it is none."""
        deadline = time.monotonic() + timeout_s
        while self._subject is None:
            path = self._folder / SUBJECT_FILE
            if path.exists():
                record = self._read(path)
                if record is None or record.kind != wire.SUBJECT:
                    raise UserError(
                        f"{path} holds no subject of a stream.",
                        "Write the folder with rgbavatar_ns.data.streams.FolderWriter.",
                    )
                self._subject = wire.parse_subject(record)
            elif self._closed or time.monotonic() >= deadline:
                return None
            else:
                time.sleep(_SHORTEST_PAUSE_S)
        return self._subject

    def next(self, timeout_s: float) -> StreamedFrame | None:
        """The next frame that has appeared, those that came together in order."""
        deadline = time.monotonic() + timeout_s
        subject = self.subject(timeout_s)
        while subject is not None and not self._closed:
            if not self._found:
                self._list(deadline)
            if self._found:
                frame = self._frame(self._found.popleft(), subject)
                if frame is not None:
                    return frame
            elif self._end_seen or time.monotonic() >= deadline:
                return None
        return None

    def go_on_after(self, index: int) -> None:
        """Pass over what is there up to this number."""
        self._seen.pass_over(index)
        self._found = deque(number for number in self._found if number > index)

    def close(self) -> None:
        """Give no more frames."""
        self._closed = True

    def _list(self, deadline: float) -> None:
        """Look for new files, or sleep until that may be done again or the deadline comes."""
        now = time.monotonic()
        if now < self._next_listing_s:
            time.sleep(max(0.0, min(self._next_listing_s, deadline) - now))
            return
        try:
            names = [entry.name for entry in os.scandir(self._folder)]
            self._reachable = True
        except OSError:
            names = []
            if self._reachable:  # gone just now
                self._reachable = False
                self.counts["source lost"] += 1
        numbers = (_FRAME_FILE.fullmatch(name) for name in names)
        found = sorted(int(number.group(1)) for number in numbers if number)
        self._found.extend(n for n in found if self._seen.add(n) in ("new", "late"))
        # The end is listed after the frames before it were there, so none is missed.
        self._end_seen = self._end_seen or (END_FILE in names and not self._found)
        took = time.monotonic() - now
        self._next_listing_s = now + took + max(_SHORTEST_PAUSE_S, _PAUSE_PER_LISTING * took)

    def _frame(self, number: int, subject: StreamSubject) -> StreamedFrame | None:
        record = self._read(self._folder / f"frame-{number:010d}.rga")
        if record is None or record.kind != wire.FRAME:
            return None
        try:
            return wire.parse_frame(record, subject, time.monotonic())
        except UserError:
            self.counts["unreadable"] += 1
            return None

    def _read(self, path: Path) -> wire.Record | None:
        reader = wire.RecordReader()
        try:
            record = next(reader.feed(path.read_bytes()), None)
        except (OSError, UserError):
            self.counts["unreadable"] += 1
            return None
        reader.close()
        self.counts["garbage bytes"] += reader.garbage_bytes
        return record
