"""Hostile performances: JSON over a WebSocket, and UDP packets of Live Link Face and of VMC."""

import importlib.util
import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from rgbavatar_ns.driving.messages import LARGEST_MESSAGE, parse_json, parse_performance
from rgbavatar_ns.driving.sources.live_link_face import head_rotation, parse_packet
from rgbavatar_ns.driving.sources.vmc import VmcSource
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.arkit import ARKIT_NAMES
from tests.driving.packets import packet
from tests.fuzz.attacks import WRONG_VALUES, Case, turned

NAME = "performances"
_LAYOUT = HeadModel.embedded().layout
_ODD_FLOATS = (float("nan"), float("inf"), -float("inf"), 3e38, -3e38, 1e-45, -0.0)
_ODD_SIZES = (-1, 0, 1, 511, 513, 2**31 - 1, -(2**31))


def cases(seed: int, count: int) -> Iterator[Case]:
    """`count` attacks; each raises UserError or returns numbers that a head can take."""
    random = np.random.default_rng(seed)
    makers = [_message, _costly_message, _live_link]
    source = None
    if importlib.util.find_spec("pythonosc") is not None:
        source = VmcSource("127.0.0.1:0")
        makers.append(lambda generator: _vmc(generator, source))
    try:
        for number in range(count):
            name, attack = makers[number % len(makers)](random)
            yield f"{number} {name}", attack
    finally:
        if source is not None:
            source.close()


def _require_usable(row: torch.Tensor, largest: float) -> None:
    assert bool(row.isfinite().all()), "numbers that are none"
    assert bool((row.abs() <= largest).all()), "numbers that no head takes"


def _message(random: np.random.Generator) -> Case:
    true: list[dict[str, Any]] = [
        {
            "type": "arkit",
            "coefficients": {name: 0.5 for name in ARKIT_NAMES[:5]},
            "pose": {"rotation": [0.1, 0.2, 0.3]},
        },
        {"type": "theta", "theta": [0.1] * _LAYOUT.size},
        {"type": "hello", "format": "rgbavatar-drive", "version": 1},
    ]
    message = true[int(random.integers(len(true)))]
    holder, told = message, []
    while True:
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        key = keys[int(random.integers(len(keys)))]
        told.append(str(key))
        if not isinstance(holder[key], dict | list) or random.random() < 0.5:
            break
        holder = holder[key]
    values = (*WRONG_VALUES, 10**400, -(10**400), "\ud800")
    holder[key] = values[int(random.integers(len(values)))]
    text = json.dumps(message)
    if random.random() < 0.2:
        text = turned(text.encode(), random).decode(errors="replace")
    return f"message {'.'.join(told)}", lambda: _hear(text)


def _costly_message(random: np.random.Generator) -> Case:
    size = LARGEST_MESSAGE
    texts = {
        "opened": "[" * size,
        "closed": "[" * (size // 2) + "]" * (size // 2),
        "keys": '{"a":' * (size // 6) + "1" + "}" * (size // 6),
        "number": '{"type":"theta","theta":[' + "9" * (size - 40) + "]}",
        "fraction": '{"type":"theta","theta":[0.' + "9" * (size - 40) + "]}",
        "zeros": '{"type":"theta","theta":[' + "0," * (size // 2 - 40) + "0]}",
        "names": json.dumps(
            {"type": "arkit", "coefficients": {f"jawOpen{i}": 1.0 for i in range(3000)}}
        ),
        "type": json.dumps({"type": "\x1b[2J" * 9000}),
    }
    name = sorted(texts)[int(random.integers(len(texts)))]
    return f"costly {name}", lambda: _hear(texts[name])


def _hear(text: str) -> None:
    sent = parse_performance(parse_json(text), _LAYOUT)
    if sent.theta is not None:
        _require_usable(sent.theta, 1e3)
        assert sent.theta.shape == (_LAYOUT.size,)
    if sent.coefficients is not None:
        _require_usable(sent.coefficients, 1.0)
    if sent.head_rotation is not None:
        _require_usable(sent.head_rotation, 13.0)


def _live_link(random: np.random.Generator) -> Case:
    values = random.random(52).tolist()
    angles = [0.1, 0.2, 0.3]
    how = str(random.choice(["turned", "cut", "garbage", "odd numbers", "odd size", "long"]))
    content = packet(values, angles)
    if how == "turned":
        content = turned(content, random, bits=8)
    elif how == "cut":
        content = content[: int(random.integers(len(content)))]
    elif how == "garbage":
        content = b"\x06" + random.bytes(int(random.integers(400)))
    elif how == "odd numbers":
        values[int(random.integers(52))] = _ODD_FLOATS[int(random.integers(len(_ODD_FLOATS)))]
        angles[int(random.integers(3))] = _ODD_FLOATS[int(random.integers(len(_ODD_FLOATS)))]
        content = packet(values, angles)
    elif how == "odd size":
        size = _ODD_SIZES[int(random.integers(len(_ODD_SIZES)))]
        content = content[:1] + struct.pack(">i", size) + content[5:]
    else:
        content += bytes(60_000)
    return f"live link {how}", lambda: _hear_packet(content)


def _hear_packet(content: bytes) -> None:
    read = parse_packet(content)
    _require_usable(read.coefficients, 1.0)
    assert np.isfinite(read.time_s)
    _require_usable(head_rotation(*(float(np.remainder(a, 2 * np.pi)) for a in read.angles)), 13.0)


def _vmc(random: np.random.Generator, source: VmcSource) -> Case:
    from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
    from pythonosc.osc_message_builder import OscMessageBuilder

    def message(address: str, *values: Any) -> Any:
        builder = OscMessageBuilder(address)
        for value in values:
            builder.add_arg(value)
        return builder.build()

    odd = [*_ODD_FLOATS, 0.5, "x" * 2000, 3, True, b"\xff" * 9][int(random.integers(12))]
    name = str(random.choice(["jawOpen", "Joy", "unknown", ""]))
    bone = [float(value) for value in random.normal(size=7)]
    bone[int(random.integers(7))] = float(random.choice(_ODD_FLOATS))
    bundle = OscBundleBuilder(IMMEDIATELY)
    bundle.add_content(message("/VMC/Ext/Blend/Val", name, odd))
    bundle.add_content(message("/VMC/Ext/Bone/Pos", "Head", *bone[: int(random.integers(8))]))
    bundle.add_content(message("/VMC/Ext/Blend/Apply"))
    content = bundle.build().dgram
    how = str(random.choice(["true", "turned", "cut", "nested"]))
    if how == "turned":
        content = turned(content, random, bits=8)
    elif how == "cut":
        content = content[: int(random.integers(len(content)))]
    elif how == "nested":
        for _ in range(int(random.integers(1, 3000))):
            head = b"#bundle\0" + bytes(7) + b"\1"
            content = head + struct.pack(">i", len(content)) + content
            if len(content) > 60_000:
                break
    return f"vmc {how}", lambda: _hear_vmc(source, content)


def _hear_vmc(source: VmcSource, content: bytes) -> None:
    source._read(content)
    _require_usable(source._coefficients(), 1.0)
    if source._turn is not None:
        _require_usable(source._turn, 4.0)
