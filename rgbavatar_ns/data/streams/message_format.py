"""Frames as messages, as docs/online.md describes them for other programs.

A binary message is the number of bytes of a JSON object (uint32, little-endian), the object in
UTF-8, and an image, a head's arrays or nothing. The subject comes first and is answered by a text,
"accepted N", where N messages of this session were had before, or "refused" and the reason.
"""

import json
import struct
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.data.native.format import camera_to_json, cameras_from_json
from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.data.streams.protocol import StreamedFrame, StreamSubject
from rgbavatar_ns.data.streams.sent_head import HEAD_FIELDS, pack_head, unpack_head
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, ThetaLayout
from rgbavatar_ns.reading import DamagedFileError, damage_told, json_numbers, parse_json

ACCEPTED, REFUSED = "accepted", "refused"
LARGEST_MESSAGE = 64 << 20
LARGEST_HEADER = 1 << 18
LARGEST_SIDE = 8192
"""Of an image, in pixels."""
_LONGEST_NAME = 200
_SIZE = struct.Struct("<I")
_CLIENT = "Send what `rgbavatar_ns.data.streams.StreamClient` sends; docs/online.md describes it."

Header = dict[str, Any]


def encode(header: Header, payload: bytes = b"") -> bytes:
    """A message's bytes."""
    text = json.dumps(header).encode()
    return _SIZE.pack(len(text)) + text + payload


def decode(message: bytes | str) -> tuple[Header, bytes]:
    """A message's header and payload; raises UserError for anything else."""
    try:
        if isinstance(message, str):
            raise DamagedFileError("it is text")
        if len(message) < _SIZE.size:
            raise DamagedFileError("it is too short")
        (size,) = _SIZE.unpack_from(message)
        if size > min(LARGEST_HEADER, len(message) - _SIZE.size):
            raise DamagedFileError(f"its header is said to have {size} bytes")
        header = parse_json(message[_SIZE.size : _SIZE.size + size])
        if not isinstance(header, dict):
            raise DamagedFileError("its header is no JSON object")
    except DamagedFileError as error:
        raise UserError(f"This is no message of a stream: {error}.", _CLIENT) from None
    return header, message[_SIZE.size + size :]


def subject_message(subject: StreamSubject) -> bytes:
    """The message that introduces a subject."""
    header = {
        "type": "subject",
        "head": subject.arrays.name,
        "identity": subject.identity.tolist(),
        "layout": subject.layout.to_json(),
        **{name: getattr(subject, name) for name in ("width", "height", "session", "client")},
    }
    if subject.arrays is HeadArrays.embedded_as(subject.arrays.name):
        return encode(header)
    fields, payload = pack_head(subject.arrays)
    return encode(header | fields, payload)


def frame_message(frame: TrackedFrame, png: bytes | None = None) -> bytes:
    """The message of a frame; `png` is its image where that is encoded already."""
    png = encode_png_rgba(frame.image_rgba) if png is None else png
    theta, camera = frame.theta.tolist(), camera_to_json(frame.camera, 0)
    return encode({"type": "frame", "index": frame.index, "theta": theta, "camera": camera}, png)


def end_message() -> bytes:
    """The message that says that no frame follows."""
    return encode({"type": "end"})


def parse_subject(message: bytes | str) -> StreamSubject:
    """The subject of a message; raises UserError for anything that is none."""
    header, payload = decode(message)
    if header.get("type") != "subject":
        raise UserError("A stream begins with its subject.", "Send it first.")
    try:
        with damage_told():
            width, height = _whole(header["width"]), _whole(header["height"])
            if max(width, height) > LARGEST_SIDE:
                raise DamagedFileError(f"images of {width} x {height} pixels are too large")
            session, client = (header.get(key, "") for key in ("session", "client"))
            if not _is_short_text(session):
                raise DamagedFileError("its session is no short text")
            if not _is_short_text(client):
                raise DamagedFileError("its client is no short text")
            identity, layout = _numbers(header["identity"]), header["layout"]
            arrays = _head(header, payload, identity)
    except DamagedFileError as error:
        raise UserError(f"A stream's subject cannot be used: {error}.", _CLIENT) from None
    theta = ThetaLayout.from_json(layout)
    return StreamSubject(arrays, identity, theta, width, height, session, client)


def parse_message(
    message: bytes | str, subject: StreamSubject, arrived_s: float
) -> StreamedFrame | Literal["end"]:
    """The frame of a message that follows the subject, or "end"; raises UserError for others."""
    header, png = decode(message)
    try:
        with damage_told():
            if header["type"] == "end":
                return "end"
            if header["type"] != "frame":
                raise DamagedFileError("its type is not 'frame'")
            index, theta = _whole(header["index"]), _numbers(header["theta"])
            named = [(f"streamed frame {index}", header["camera"])]
    except DamagedFileError as error:
        raise UserError(f"A streamed frame is incomplete: {error}.", _CLIENT) from None
    camera = cameras_from_json(named, subject.width, subject.height)
    return StreamedFrame(index, theta, camera, arrived_s, subject.session, png=png)


def parse_answer(answer: bytes | str) -> int:
    """How many messages of its session a client need not send again; UserError if refused."""
    word, _, more = str(answer).partition(" ")
    if word == ACCEPTED and more.isdecimal():
        return int(more)
    if word == REFUSED:
        raise UserError("The stream refuses this client.", more)
    raise UserError(
        "Something else than a stream of frames listens at this address.",
        "Give the address at which `ns-train rgbavatar-online` waits for frames.",
    )


def _is_short_text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST_NAME


def _whole(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 1 << 62:
        raise DamagedFileError(f"{str(value)[:40]} is no whole number that is not negative")
    return value


def _numbers(values: Any) -> Float[Tensor, "_"]:
    if not isinstance(values, list):
        raise DamagedFileError("theta and identity are lists of numbers")
    return torch.from_numpy(json_numbers(values, (len(values),)).astype(np.float32))


def _head(header: Header, payload: bytes, identity: Float[Tensor, "I"]) -> HeadArrays:
    """The embedded head, or the one that is sent."""
    name = str(header["head"])[:_LONGEST_NAME]
    embedded = HeadArrays.embedded_as(name)
    if payload:
        return unpack_head(payload, {field: header[field] for field in HEAD_FIELDS}, name, identity)
    if embedded is None:
        raise DamagedFileError(
            f"the head '{name}' is not known here: send its arrays with the subject, or use the "
            "embedded head"
        )
    return embedded
