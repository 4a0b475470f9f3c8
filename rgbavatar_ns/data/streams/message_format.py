"""Frames as bytes: one format for sockets and for the files of a folder.

A record is a header of 28 bytes and three parts. Little-endian, nothing is pickled:

    offset  size
    0       4     magic, 0x93 "RGA"
    4       2     version, 1
    6       2     kind: 1 subject, 2 frame, 3 end
    8       4     bytes of the JSON part, at most 4 MiB
    12      4     bytes of the theta part, at most 64 KiB
    16      4     bytes of the data part, at most 64 MiB
    20      4     CRC-32 of the three parts
    24      4     CRC-32 of the 24 bytes before

The JSON part is an object in UTF-8, theta is float32, and what they hold depends on the kind:

    subject  JSON: head (its name), identity [I], layout (as in dataset.json), width, height,
             session (any text); data: the head's npz, empty for the embedded head
    frame    JSON: index (a whole number, unique within the session), camera (as in
             dataset.json); theta; data: the image, a PNG with straight alpha
    end      nothing; no frame follows

The subject comes first. Where bytes are damaged the reader looks for the next record.
"""

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from rgbavatar_ns.data.native.format import camera_to_json, cameras_from_json
from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.data.streams.protocol import StreamedFrame, StreamSubject
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, ThetaLayout

MAGIC = b"\x93RGA"
VERSION = 1
SUBJECT, FRAME, END = 1, 2, 3
LARGEST_JSON, LARGEST_THETA, LARGEST_DATA = 4 << 20, 64 << 10, 64 << 20
LARGEST_HEAD = 512 << 20
"""Of a head's arrays in memory."""
_HEADER = struct.Struct("<4sHHIIIII")
_CLIENT = "Send what `rgbavatar_ns.data.streams.StreamClient` sends."


@dataclass(frozen=True)
class Record:
    """One record taken apart; the parts are not checked beyond their sums."""

    kind: int
    fields: dict[str, Any] = field(default_factory=dict)
    theta: bytes = b""
    data: bytes = b""


def encode(record: Record) -> bytes:
    """The record's bytes."""
    text = json.dumps(record.fields).encode() if record.fields else b""
    body = text + record.theta + record.data
    sizes = len(text), len(record.theta), len(record.data)
    head = struct.pack("<4sHHIIII", MAGIC, VERSION, record.kind, *sizes, zlib.crc32(body))
    return head + struct.pack("<I", zlib.crc32(head)) + body


def subject_record(subject: StreamSubject) -> bytes:
    """The bytes that introduce a subject."""
    arrays, data = subject.arrays, b""
    embedded = HeadArrays.embedded()
    if arrays is not embedded:
        packed = io.BytesIO()
        np.savez_compressed(packed, **{k: np.array(v) for k, v in arrays.to_state().items()})
        data = packed.getvalue()
    fields = {
        "head": arrays.name,
        "identity": subject.identity.tolist(),
        "layout": subject.layout.to_json(),
        "width": subject.width,
        "height": subject.height,
        "session": subject.session,
    }
    return encode(Record(SUBJECT, fields, data=data))


def frame_record(frame: TrackedFrame, png: bytes | None = None) -> bytes:
    """The bytes of a frame; `png` is its image where that is encoded already."""
    png = encode_png_rgba(frame.image_rgba, 1) if png is None else png
    fields = {"index": frame.index, "camera": camera_to_json(frame.camera, 0)}
    theta = frame.theta.detach().cpu().numpy().astype("<f4").tobytes()
    return encode(Record(FRAME, fields, theta, png))


def end_record() -> bytes:
    """The bytes that say that no frame follows."""
    return encode(Record(END))


def parse_subject(record: Record) -> StreamSubject:
    """The subject of a record; raises UserError for anything that is none."""
    fields = record.fields
    try:
        identity = torch.tensor(fields["identity"], dtype=torch.float32)
        width, height = _whole(fields["width"]), _whole(fields["height"])
        layout = ThetaLayout.from_json(fields["layout"])
        name, session = str(fields["head"]), str(fields.get("session", ""))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"A stream's subject is incomplete: {error}.", _CLIENT) from None
    return StreamSubject(_head(name, record.data), identity, layout, width, height, session)


def parse_frame(record: Record, subject: StreamSubject, arrived_s: float) -> StreamedFrame:
    """The frame of a record; raises UserError for anything that is none."""
    try:
        index = _whole(record.fields["index"])
        theta = np.frombuffer(record.theta, "<f4").astype(np.float32)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"A streamed frame is incomplete: {error}.", _CLIENT) from None
    named = [(f"streamed frame {index}", record.fields.get("camera"))]
    camera = cameras_from_json(named, subject.width, subject.height)
    values = torch.from_numpy(theta)
    return StreamedFrame(index, values, camera, arrived_s, subject.session, png=record.data)


def _whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 62:
        raise ValueError(f"{value!r} is no whole number that is not negative")
    return value


def _head(name: str, packed: bytes) -> HeadArrays:
    if not packed:
        embedded = HeadArrays.embedded()
        if name != embedded.name:
            raise UserError(
                f"The stream is of the head '{name}', which is not known here.",
                f"Send its arrays with the subject, or use the embedded head '{embedded.name}'.",
            )
        return embedded
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > LARGEST_HEAD:
                raise ValueError(f"it holds more than {LARGEST_HEAD >> 20} MiB")
        with np.load(io.BytesIO(packed), allow_pickle=False) as file:
            state = {key: _plain(file[key]) for key in file.files}
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise UserError(f"A stream's head model cannot be read: {error}.", _CLIENT) from None
    return HeadArrays.from_state(state)


def _plain(value: np.ndarray) -> Any:
    """Text and single numbers as what they were before numpy packed them."""
    if value.dtype.kind in "US" or value.ndim == 0:
        return value.tolist()
    return torch.from_numpy(value)


class RecordReader:
    """Takes bytes apart into records as they come, and finds its way back after damage.

    At most one record of the largest size is held. `garbage_bytes` counts what belonged to no
    whole record.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.garbage_bytes = 0

    def feed(self, data: bytes) -> Iterator[Record]:
        """Records that are complete with `data`.

        Raises:
            UserError: a whole record is of another version of the format.
        """
        self._buffer += data
        while True:
            size = self._next_record()
            if size is None:
                return
            body = bytes(self._buffer[_HEADER.size : size])
            _, version, kind, *sizes, checksum, _ = _HEADER.unpack_from(self._buffer)
            record = None
            if zlib.crc32(body) == checksum:
                record = _taken_apart(kind, sizes, body)
            if record is None:
                self._skip(1)
                continue
            del self._buffer[:size]
            if version != VERSION:
                raise UserError(
                    f"The stream's records have version {version}; version {VERSION} is known.",
                    "Use the same version of rgbavatar-ns on both sides.",
                )
            yield record

    def close(self) -> None:
        """Nothing follows: what is left is a record cut short."""
        self.garbage_bytes += len(self._buffer)
        self._buffer.clear()

    def _next_record(self) -> int | None:
        """The size of the record at the buffer's start, once all of it is there."""
        while True:
            place = self._buffer.find(MAGIC)
            if place < 0:
                # The magic's first bytes may have come already.
                self._skip(max(0, len(self._buffer) - len(MAGIC) + 1))
                return None
            self._skip(place)
            if len(self._buffer) < _HEADER.size:
                return None
            _, _, _, *sizes, _, checksum = _HEADER.unpack_from(self._buffer)
            sound = zlib.crc32(memoryview(self._buffer)[: _HEADER.size - 4]) == checksum
            limits = (LARGEST_JSON, LARGEST_THETA, LARGEST_DATA)
            if sound and all(size <= limit for size, limit in zip(sizes, limits)):
                whole = _HEADER.size + sum(sizes)
                return whole if len(self._buffer) >= whole else None
            self._skip(1)

    def _skip(self, count: int) -> None:
        self.garbage_bytes += count
        del self._buffer[:count]


def _taken_apart(kind: int, sizes: list[int], body: bytes) -> Record | None:
    text, theta = sizes[0], sizes[0] + sizes[1]
    try:
        fields = json.loads(body[:text]) if text else {}
    except (ValueError, RecursionError):
        return None
    if not isinstance(fields, dict):
        return None
    return Record(kind, fields, body[text:theta], body[theta:])
