"""ARKit over UDP: the packets of Live Link Face (Unreal Engine) and of the senders that copy it.

A packet, big-endian, is: version (uint8, 6), device and subject (each an int32 length and UTF-8
text), frame (int32), part of a frame (float32), rate (int32 / int32), a count (uint8, 61) and as
many float32: 52 coefficients in the order of `ARKIT_NAMES`, then yaw, pitch and roll of the head
and of both eyes in radians. Source: Unreal Engine's AppleARKitFaceSupport, and what reads its
packets.
"""

import math
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from rgbavatar_ns.driving.source import PerformanceFrame
from rgbavatar_ns.driving.sources.datagrams import Datagrams
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arkit import ARKIT_NAMES

DEFAULT_ADDRESS = "127.0.0.1:11111"
"""The port that Live Link Face sends to by default."""
HEAD_ANGLES = ("HeadYaw", "HeadPitch", "HeadRoll")
"""The three numbers after the coefficients."""
_VERSION = 6
_COUNT = 61
_TIME = struct.Struct(">ifii")
_LONGEST_TEXT = 512
_MOST_RATE = 1000
_WAITING = 8
"""Packets kept until one is asked for: only the newest that can be read counts."""
_SILENT_S = 2.0
"""After so long another device may take over."""


@dataclass(frozen=True)
class LiveLinkPacket:
    """One packet's content."""

    device: str
    subject: str
    frame: int
    time_s: float
    """By the device's own count of frames and rate."""
    coefficients: Float[Tensor, "52"]
    angles: tuple[float, float, float]
    """Yaw, pitch and roll of the head as sent."""
    out_of_range: int
    """How many coefficients were below 0 or above 1; they are held to it."""


def head_rotation(yaw: float, pitch: float, roll: float) -> Float[Tensor, "3"]:
    """Axis-angle in the head's axes for Unreal's angles, radians.

    Unreal's yaw turns to the right, its pitch up, its roll to the right shoulder, of one who looks
    along; ours turn about y up, x to the subject's left and z out of the face.
    """
    turned = Rotation.from_euler("YXZ", [-yaw, -pitch, roll])
    return torch.from_numpy(turned.as_rotvec()).float()


def parse_packet(packet: bytes) -> LiveLinkPacket:
    """Read a packet; raises UserError for another version or anything else."""
    if not packet or packet[0] != _VERSION:
        version = packet[0] if packet else "nothing"
        raise UserError(
            f"A packet begins with {version}, not with Live Link Face's version {_VERSION}.",
            "Send ARKit data in Live Link Face's format.",
        )
    try:
        device, at = _text(packet, 1)
        subject, at = _text(packet, at)
        frame, part, numerator, denominator = _TIME.unpack_from(packet, at)
        count = packet[at + _TIME.size]
        if count != _COUNT:
            raise ValueError(f"it has {count} numbers, not {_COUNT}")
        values = struct.unpack_from(f">{count}f", packet, at + _TIME.size + 1)
    except (struct.error, ValueError, IndexError) as error:
        raise UserError(
            f"A packet of {len(packet)} bytes cannot be read: {error}.",
            "Send ARKit data in Live Link Face's format.",
        ) from None
    if not all(math.isfinite(value) for value in values):
        raise UserError("A packet holds NaN.", "Check the sender.")
    told = torch.tensor(values[: len(ARKIT_NAMES)])
    yaw, pitch, roll = values[52:55]
    rate = numerator / denominator if denominator > 0 else 0.0
    known_rate = rate if 0 < rate <= _MOST_RATE else 60.0
    moment = frame + (part if math.isfinite(part) else 0.0)
    outside = int(((told < 0) | (told > 1)).sum())
    return LiveLinkPacket(
        device, subject, frame, moment / known_rate, told.clamp(0, 1), (yaw, pitch, roll), outside
    )


def _text(packet: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from(">i", packet, at)
    begin, end = at + 4, at + 4 + length
    if not 0 <= length <= _LONGEST_TEXT or end > len(packet):
        raise ValueError(f"it has a text of {length} bytes")
    return packet[begin:end].decode("utf-8", "replace"), end


class LiveLinkFaceSource:
    """Listens for one device at a time; the newest packet counts.

    angle_gain: of the head's yaw, pitch and roll, for senders of degrees (.01745) or of mirrored
    turns (-1). Raises UserError where the address is taken or not of this machine unasked.
    """

    head = None
    ended = False

    def __init__(
        self,
        listen: str = DEFAULT_ADDRESS,
        allow_remote: bool = False,
        angle_gain: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> None:
        self._datagrams = Datagrams(listen, allow_remote, waiting=_WAITING)
        self.counts = Counter[str]()
        self.waits_for = f"ARKit packets of Live Link Face at {self._datagrams.address} (UDP)"
        self._gain = tuple(angle_gain)
        self._device: str | None = None
        self._heard_s = -math.inf
        self._index = 0

    @property
    def address(self) -> str:
        """Where it listens."""
        return self._datagrams.address

    def next(self, timeout_s: float) -> PerformanceFrame | None:
        """The newest packet of the device that is followed."""
        waiting = self._datagrams.take(timeout_s)
        self.counts["skipped"] += self._datagrams.dropped()
        for place, (captured_s, packet) in enumerate(reversed(waiting)):
            try:
                read = parse_packet(packet)
            except UserError as error:
                self.counts["another version" if "version" in error.cause else "unreadable"] += 1
                continue
            if read.device != self._device and captured_s - self._heard_s < _SILENT_S:
                self.counts["another device"] += 1
                continue
            self._device, self._heard_s = read.device, captured_s
            self.counts["values beyond 0..1"] += read.out_of_range
            self.counts["skipped"] += len(waiting) - 1 - place
            self._index += 1
            angles = (a * g for a, g in zip(read.angles, self._gain))
            turn = head_rotation(*(math.remainder(angle, 2 * math.pi) for angle in angles))
            return PerformanceFrame(
                self._index,
                captured_s,
                captured_s,
                coefficients=read.coefficients,
                head_rotation=turn,
            )
        return None

    def close(self) -> None:
        """Listen no more."""
        self._datagrams.close()
