"""What is said over a WebSocket about a performance: JSON texts, format "rgbavatar-drive" 1."""

import json
import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.head.arkit import ARKIT_NAMES, arkit_coefficients

FORMAT, VERSION = "rgbavatar-drive", 1
LARGEST_MESSAGE = 1 << 16
"""Bytes; a theta of a thousand numbers has 20 kB."""
_LONGEST_TURN = 4 * math.pi
_LARGEST = torch.finfo(torch.float32).max
_REMEDY = "See docs/driving.md for the messages."


def hello(layout: ThetaLayout) -> str:
    """The first message to a page: whose theta follows."""
    return _json(type="hello", format=FORMAT, version=VERSION, layout=layout.to_json())


def theta_message(index: int, theta: Float[Tensor, "H"]) -> str:
    """One frame's theta, to six digits."""
    return _json(type="theta", index=index, theta=[round(x, 6) for x in theta.tolist()])


def status_message(text: str) -> str:
    """A line that the page shows."""
    return _json(type="status", text=text)


def error_message(text: str) -> str:
    """What was wrong with a message."""
    return _json(type="error", text=text)


def _json(**values: Any) -> str:
    return json.dumps(values, allow_nan=False, separators=(",", ":"))


@dataclass(frozen=True)
class SentPerformance:
    """What a program sent: ARKit's coefficients or the avatar's own theta."""

    coefficients: Float[Tensor, "52"] | None = None
    head_rotation: Float[Tensor, "3"] | None = None
    theta: Float[Tensor, "H"] | None = None
    out_of_range: int = 0


def parse_json(text: str | bytes) -> dict[str, Any]:
    """A message with a type; raises UserError for anything else."""
    try:
        if isinstance(text, bytes):
            raise ValueError("it is binary")
        message = json.loads(text)
        if not isinstance(message, dict) or not isinstance(message.get("type"), str):
            raise ValueError("it is no object with a type")
    except (ValueError, RecursionError) as error:
        raise UserError(f"A message cannot be read: {error}.", _REMEDY) from None
    return message


def check_hello(message: dict[str, Any]) -> None:
    """Raise UserError for a greeting of another format or version."""
    told = message.get("format"), message.get("version")
    if told != (FORMAT, VERSION):
        raise UserError(f"The sender speaks {told[0]} {told[1]}, not {FORMAT} {VERSION}.", _REMEDY)


def parse_performance(message: dict[str, Any], layout: ThetaLayout) -> SentPerformance:
    """Read an "arkit" or "theta" message; raises UserError for numbers that are none."""
    kind = message["type"]
    if kind == "arkit":
        named = message.get("coefficients", {})
        if not isinstance(named, dict) or not all(_is_number(v) for v in named.values()):
            raise UserError("The coefficients are no numbers by name.", _REMEDY)
        row = arkit_coefficients(named)
        pose = message.get("pose")
        if pose is not None and not isinstance(pose, dict):
            raise UserError("pose is no object with a rotation.", _REMEDY)
        rotation = None if pose is None else pose.get("rotation")
        turn = None if rotation is None else _numbers(rotation, 3, "pose.rotation")
        if turn is not None and float(turn.norm()) > _LONGEST_TURN:
            raise UserError("pose.rotation is longer than two turns.", "Give radians.")
        outside = int(((row < 0) | (row > 1)).sum())
        return SentPerformance(row.clamp(0, 1), turn, out_of_range=outside)
    if kind == "theta":
        theta = _numbers(message.get("theta"), layout.size, "theta")
        if (absurd := layout.absurd(theta)) is not None:
            raise UserError(f"No head does this: {absurd}.", _REMEDY)
        return SentPerformance(theta=theta)
    raise UserError(
        f"There is no message of type {kind[:40]}.",
        f"Send one of hello, arkit (names such as {first_few(ARKIT_NAMES, 2)}), theta.",
    )


def _numbers(values: Any, count: int, name: str) -> Float[Tensor, "N"]:
    if not isinstance(values, list) or len(values) != count or not all(map(_is_number, values)):
        told = f"{len(values)} values" if isinstance(values, list) else "no list"
        raise UserError(f"{name} is not {count} numbers, but {told}.", _REMEDY)
    return torch.tensor([float(value) for value in values])


def _is_number(value: Any) -> bool:
    # JSON's may be too large for a float.
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= _LARGEST
