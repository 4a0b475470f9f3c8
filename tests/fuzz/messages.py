"""Hostile messages of a stream: true ones changed in their bytes, their JSON, or their payload."""

import dataclasses
import io
import json
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import safetensors.numpy

from rgbavatar_ns.data import LocalGlobalPools
from rgbavatar_ns.data.streams import Ingest, ReplayBuffer, StreamedFrame
from rgbavatar_ns.data.streams import message_format as messages
from rgbavatar_ns.errors import UserError
from tests.data.small_dataset import HEIGHT, WIDTH
from tests.data.streaming import HEAD, GivenStream, subject, tracked

NAME = "messages of a stream"
MOST_SECONDS = 2.0

_Random = np.random.Generator
_Case = tuple[str, Callable[[], object]]

_WHO = subject("mine")
_SUBJECT = messages.subject_message(_WHO)
_OTHER = messages.subject_message(
    dataclasses.replace(_WHO, arrays=dataclasses.replace(HEAD.arrays, name="other"))
)
_FRAME = messages.frame_message(tracked(0))
_TRUE = {"subject": _SUBJECT, "head": _OTHER, "frame": _FRAME}

_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 3, 0.5, -0.0, 1e-30, 1e5, 1e30, -1e30, 1e300, 10**18, 10**400),
    *(2**31, 2**32, 2**62 - 1, 2**62, 2**63, -(2**63), float("nan"), float("inf"), float("-inf")),
    *("", "1", "frame", "subject", "end", "\x1b[2J", "\ud800", "x" * 100_000, "٣"),
    *([], {}, [[]], [{}], [None], [True] * 3, ["1"] * 3, [10**400], [1e300] * 2, [0.0] * 100_000),
    *({"0": 1}, [[[1.0]]], [[1.0, 0.0], [0.0]], [float("nan")] * 2, [0.0, 0.0], [-1.0, 1.0]),
    *([[1e30] * 4] * 4, np.eye(4).tolist(), np.diag([1, 1, -1, 1]).tolist()),
)


def cases(seed: int, count: int) -> Iterator[_Case]:
    """`count` attacks; each raises UserError or returns, and the run it strikes goes on."""
    random = np.random.default_rng(seed)
    makers = (
        _changed_bytes,
        _changed_json,
        _changed_number,
        _changed_image,
        _changed_head,
        _costly,
    )
    for number in range(count):
        maker = makers[number % len(makers)]
        name, message = maker(random)
        yield f"{number} {maker.__name__.strip('_')} {name}", _attack(message)


def _attack(message: bytes | str) -> Callable[[], object]:
    def attack() -> None:
        began_s = time.thread_time()
        try:
            _receive(message)
        finally:
            took_s = time.thread_time() - began_s
            if took_s > MOST_SECONDS:
                raise AssertionError(f"it took {took_s:.1f} s")

    return attack


def _receive(message: bytes | str) -> None:
    """As a listener takes it: as a greeting, and as a frame between two true ones."""
    refusals: list[UserError] = []
    try:
        messages.parse_subject(message)
    except UserError as refusal:
        refusals.append(refusal)
    frames = ReplayBuffer(_WHO, LocalGlobalPools(4, 4))
    ingest = Ingest(GivenStream([]), _WHO, frames)
    _take_in(ingest, messages.frame_message(tracked(0)))
    try:
        _take_in(ingest, message)
    except UserError as refusal:
        refusals.append(refusal)
    taken_in = ingest.counts()["taken in"]
    for index in (11, 12):
        _take_in(ingest, messages.frame_message(tracked(index)))
    assert ingest.counts()["taken in"] == taken_in + 2, ingest.counts()
    drawn = frames.batch(4)
    assert drawn.images_rgba.shape[1:] == (HEIGHT, WIDTH, 4)
    assert bool(HEAD(drawn.theta, _WHO.identity).abs().max() < 1000)
    assert bool(drawn.cameras.world_to_camera.abs().max() < 1e4)
    assert bool(drawn.cameras.focal_px.max() < 1e6)
    assert bool(drawn.cameras.focal_px.min() > 1e-3)
    if len(refusals) == 2:
        raise refusals[1]


def _take_in(ingest: Ingest, message: bytes | str) -> None:
    parsed = messages.parse_message(message, _WHO, 0.0)
    if isinstance(parsed, StreamedFrame):
        ingest.take_in(parsed)


def _pick(random: _Random, among: Any) -> Any:
    return among[random.integers(len(among))]


def _changed_bytes(random: _Random) -> tuple[str, bytes | str]:
    name = _pick(random, sorted(_TRUE))
    message = bytearray(_TRUE[name])
    how = _pick(random, ("flip", "cut", "insert", "repeat", "size", "zeros", "text"))
    place = int(random.integers(min(len(message), 3000)))
    if how == "flip":
        for _ in range(random.integers(1, 9)):
            message[random.integers(min(len(message), 3000))] ^= 1 << random.integers(8)
    elif how == "cut":
        del message[place:]
    elif how == "insert":
        message[place:place] = random.bytes(random.integers(1, 40))
    elif how == "repeat":
        message[place:place] = message[place : place + 100]
    elif how == "size":
        message[:4] = struct.pack("<I", _pick(random, (0, 1, 2**31, 2**32 - 1, len(message) - 4)))
    elif how == "zeros":
        message[place : place + 20] = bytes(20)
    else:
        return name, bytes(message).decode("latin-1")
    return f"{name} {how}", bytes(message)


def _changed_json(random: _Random) -> tuple[str, bytes]:
    name = _pick(random, sorted(_TRUE))
    header, payload = messages.decode(_TRUE[name])
    for _ in range(random.integers(1, 3)):
        place, told = header, []
        while True:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            if not keys:
                break
            key = _pick(random, keys)
            told.append(str(key))
            if isinstance(place[key], dict | list) and random.random() < 0.6:
                place = place[key]
            elif random.random() < 0.15:
                del place[key]
                break
            else:
                place[key] = _pick(random, _VALUES)
                told.append(repr(place[key])[:30])
                break
    return f"{name} {'.'.join(told)}", messages.encode(header, payload)


def _changed_number(random: _Random) -> tuple[str, bytes]:
    """What JSON and types allow, and no tracker means."""
    header, image = messages.decode(_FRAME)
    header["index"] = 5
    camera = header["camera"]
    places = {
        "index": (header, "index"),
        "theta": (header["theta"], int(random.integers(len(header["theta"])))),
        "focal": (camera["focal_px"], int(random.integers(2))),
        "centre": (camera["principal_point_px"], int(random.integers(2))),
        "position": (camera["world_to_camera"][random.integers(3)], 3),
        "rotation": (camera["world_to_camera"][random.integers(3)], int(random.integers(3))),
    }
    name = _pick(random, sorted(places))
    (place, key), large = places[name], 10.0 ** random.uniform(-30, 30)
    value = 2 ** int(random.integers(20, 62)) if name == "index" else large
    place[key] = value
    return f"{name} {value:g}", messages.encode(header, image)


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG."""
    whole = kind + data
    return struct.pack(">I", len(data)) + whole + struct.pack(">I", zlib.crc32(whole))


def png(
    width: int = WIDTH,
    height: int = HEIGHT,
    depth: int = 8,
    color: int = 6,
    interlace: int = 0,
    before: bytes = b"",
    data: bytes | None = None,
) -> bytes:
    """A PNG that claims what it is told to; `before` are chunks ahead of its data."""
    head = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, interlace)
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(color, 1)
    row = 1 + -(-min(width, 4096) * channels * depth // 8)
    data = zlib.compress(bytes(row * min(height, 64))) if data is None else data
    parts = [chunk(b"IHDR", head), before, chunk(b"IDAT", data), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def _changed_image(random: _Random) -> tuple[str, bytes]:
    palette = chunk(b"PLTE", bytes(range(12)))
    bomb = b"a\0\0" + zlib.compress(bytes(1_000_000), 9)
    jpeg = cv2.imencode(".jpg", np.zeros((HEIGHT, WIDTH, 3), np.uint8))[1].tobytes()
    made = {
        "empty": b"",
        "8192": png(8192, 8192),
        "60000": png(60_000, 60_000),
        "no width": png(0, HEIGHT),
        "2**31": png(2**31 - 1, 2**31 - 1),
        "jpeg": jpeg,
        "jpeg in a chunk": png(data=jpeg),
        "text bombs": png(before=chunk(b"zTXt", bomb) * 60),
        "profile bomb": png(before=chunk(b"iCCP", b"a\0\0" + bomb[3:])),
        "padded": png(before=chunk(b"teXt", bytes(1 << 20))),
        "palette": png(depth=8, color=3, before=palette),
        "palette missing": png(depth=8, color=3),
        "palette with alpha": png(color=3, before=palette + chunk(b"tRNS", b"\0\1")),
        "turned": png(before=chunk(b"eXIf", b"II*\0\x08\0\0\0\1\0\x12\1\3\0\1\0\0\0\6\0\0\0")),
        "two headers": png(before=png()[8:33]),
        "larger second header": png(before=png(9000, 9000)[8:33]),
        "data of more rows": png(data=zlib.compress(bytes(1_000_000))),
        "data of fewer rows": png(data=zlib.compress(bytes(10))),
        "no data": png(data=b""),
        "data is none": png(data=b"\xff" * 50),
    }
    for depth in (1, 2, 4, 8, 16, 255):
        for color in (0, 2, 4, 6, 7):
            made[f"depth {depth} color {color}"] = png(depth=depth, color=color)
            made[f"interlaced {depth} {color}"] = png(depth=depth, color=color, interlace=1)
    name = _pick(random, sorted(made))
    image = bytearray(made[name])
    if random.random() < 0.3:
        name += " cut"
        del image[random.integers(len(image) + 1) :]
    header, _ = messages.decode(_FRAME)
    return name, messages.encode({**header, "index": 5}, bytes(image))


def _changed_head(random: _Random) -> tuple[str, bytes]:
    header, payload = messages.decode(_OTHER)
    arrays = safetensors.numpy.load(payload)
    name = _pick(random, sorted(arrays))
    own = arrays[name]
    how = _pick(random, ("type", "values", "shape", "missing", "vertices", "faces", "overlap"))
    if how == "type":
        kind = _pick(random, ("bool", "u1", "i1", "u2", "u4", "u8", "i8", "f2", "f4", "f8"))
        arrays[name] = own.astype(kind)
    elif how == "values":
        value = _pick(random, (np.nan, np.inf, 0, 1, -1, 1e30, 6e4))
        with np.errstate(all="ignore"):
            arrays[name] = np.full_like(own, np.asarray(value).astype(own.dtype))
    elif how == "shape":
        shape = _pick(random, ((), (0,), (1,), (0, 3), (3, 3), (1, 3, 36), (2**20,), (5, 1)))
        arrays[name] = np.zeros(shape, own.dtype)
    elif how == "missing":
        del arrays[name]
    elif how == "vertices":
        count = int(_pick(random, (1, 2, 300_000)))
        for part, dims in (("v_template", (3,)), ("posedirs", (3, 36)), ("shapedirs", (3, 82))):
            arrays[part] = np.zeros((count, *dims), np.float16)[: 100_000 if dims[1:] else None]
        arrays["joint_regressor"] = np.zeros((5, count), np.float16)
        arrays["skinning_weights"] = np.zeros((count, 5), np.float16)
        arrays["faces"] = arrays["faces"] * 0
        arrays = {part: value for part, value in arrays.items() if "group" not in part}
    elif how == "faces":
        for part in ("faces", "uv_faces"):
            arrays[part] = np.zeros((1_000_000, 3), np.int32)
    else:
        arrays["uv"] = np.resize(np.float32([[-9, -9], [9, -9], [0, 9]]), arrays["uv"].shape)
        arrays["uv_faces"] = np.tile(np.int32([[0, 1, 2]]), (len(arrays["uv_faces"]), 1))
    return f"{name} {how}", messages.encode(header, safetensors.numpy.save(arrays))


def _costly(random: _Random) -> tuple[str, bytes]:
    """As much work as bytes can ask for."""
    size = messages.LARGEST_HEADER
    made = {
        "opened": b"[" * size,
        "closed": b"[" * (size // 2) + b"]" * (size // 2),
        "nested again and again": b"[" + (b"[" * 900 + b"]" * 900 + b",") * (size // 1900) + b"0]",
        "keys": b'{"a":' * (size // 6) + b"1" + b"}" * (size // 6),
        "empty lists": b"[" + b"[]," * (size // 3 - 3) + b"[]]",
        "a long number": b'{"type":"frame","index":' + b"9" * (size - 30) + b"}",
        "a long fraction": b'{"type":"frame","index":0,"theta":[0.' + b"9" * (size - 60) + b"]}",
        "an exponent": b'{"type":"frame","index":1e' + b"9" * (size - 40) + b"}",
        "zeros": b'{"type":"frame","index":0,"theta":[' + b"0," * (size // 2 - 40) + b"0]}",
        "escapes": b'{"type":"' + rb"\ud83d\ude00" * (size // 12 - 10) + b'"}',
        "lone surrogates": b'{"type":"' + rb"\ud83d" * (size // 6 - 10) + b'"}',
        "one key": b"{" + b'"type":1,' * (size // 9 - 1) + b'"type":2}',
        "spaces": b" " * (size - 2) + b"{}",
        "quote": b'"' + b"\\" * (size - 2),
        "fields": json.dumps(
            {
                "type": "subject",
                **{"head": "makehuman", "identity": [0.0] * 50_000, "width": 8, "height": 8},
                "layout": [{"name": str(i), "size": 10**18, "form": "linear"} for i in range(9000)],
            }
        ).encode(),
    }
    name = _pick(random, sorted(made))
    text = made[name][:size]
    image = io.BytesIO(_FRAME).getvalue()[-50:] if random.random() < 0.5 else b""
    return name, struct.pack("<I", len(text)) + text + image


_MAKERS = (_changed_bytes, _changed_json, _changed_number, _changed_image, _changed_head, _costly)
