"""Blend shapes of the VMC protocol (Open Sound Control over UDP), as VTuber programs send them.

`/VMC/Ext/Blend/Val name value` tells one, `/VMC/Ext/Blend/Apply` ends a frame, and
`/VMC/Ext/Bone/Pos Head x y z qx qy qz qw` tells the head's turn in Unity's axes (x right, y up, z
ahead, left-handed). Names are ARKit's ("perfect sync") or VRM's few. Source: protocol.vmc.info.
"""

import math
import time
from collections import Counter

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from rgbavatar_ns.driving.source import PerformanceFrame
from rgbavatar_ns.driving.sources.datagrams import Datagrams
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arkit import ARKIT_NAMES

DEFAULT_ADDRESS = "127.0.0.1:39539"
"""The port of the protocol's marionettes."""
_WAITING = 1024
"""Each blend shape may come in a packet of its own: some twenty frames."""
_HEAD = "Head"
_BOTH_EYES = {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0}
_VRM = {
    "blink": _BOTH_EYES,
    "blink_l": {"eyeBlinkLeft": 1.0},
    "blinkleft": {"eyeBlinkLeft": 1.0},
    "blink_r": {"eyeBlinkRight": 1.0},
    "blinkright": {"eyeBlinkRight": 1.0},
    "a": {"jawOpen": 0.7},
    "aa": {"jawOpen": 0.7},
    "i": {"jawOpen": 0.15, "mouthStretchLeft": 0.5, "mouthStretchRight": 0.5},
    "ih": {"jawOpen": 0.15, "mouthStretchLeft": 0.5, "mouthStretchRight": 0.5},
    "u": {"jawOpen": 0.15, "mouthPucker": 0.7},
    "ou": {"jawOpen": 0.15, "mouthPucker": 0.7},
    "e": {"jawOpen": 0.35, "mouthStretchLeft": 0.3, "mouthStretchRight": 0.3},
    "ee": {"jawOpen": 0.35, "mouthStretchLeft": 0.3, "mouthStretchRight": 0.3},
    "o": {"jawOpen": 0.4, "mouthFunnel": 0.6},
    "oh": {"jawOpen": 0.4, "mouthFunnel": 0.6},
    "joy": {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8},
    "happy": {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8},
    "surprised": {"browInnerUp": 0.8, "eyeWideLeft": 0.5, "eyeWideRight": 0.5},
}
"""VRM's own expressions (0.x and 1.0) in ARKit's; ours, by what they are named after."""


class VmcSource:
    """Listens to VMC senders; each applied frame counts, the newest wins.

    Raises UserError where python-osc is not installed, or as `Datagrams`.
    """

    head = None
    ended = False

    def __init__(self, listen: str = DEFAULT_ADDRESS, allow_remote: bool = False) -> None:
        try:
            from pythonosc.osc_packet import OscPacket, ParseError
        except ImportError:
            raise UserError(
                "Open Sound Control needs python-osc.", "pip install python-osc"
            ) from None
        self._packet, self._parse_error = OscPacket, ParseError
        self._datagrams = Datagrams(listen, allow_remote, waiting=_WAITING)
        self.counts = Counter[str]()
        self.waits_for = f"VMC blend shapes at {self._datagrams.address} (OSC over UDP)"
        self._arkit = {name.lower(): name for name in ARKIT_NAMES}
        self._told: dict[str, float] = {}
        self._turn: Float[Tensor, 3] | None = None
        self._index = 0

    @property
    def address(self) -> str:
        """Where it listens."""
        return self._datagrams.address

    def next(self, timeout_s: float) -> PerformanceFrame | None:
        """The newest frame that was applied."""
        until_s = time.monotonic() + timeout_s
        while (left_s := until_s - time.monotonic()) > 0:
            applied = [
                (came_s, coefficients, turn)
                for came_s, packet in self._datagrams.take(left_s)
                for coefficients, turn in self._read(packet)
            ]
            self.counts["skipped"] += max(len(applied) - 1, 0)
            if applied:
                self._index += 1
                came_s, coefficients, turn = applied[-1]
                return PerformanceFrame(
                    self._index, came_s, came_s, coefficients=coefficients, head_rotation=turn
                )
        return None

    def _read(self, packet: bytes) -> list[tuple[Float[Tensor, "52"], Float[Tensor, "3"] | None]]:
        """Take over what a packet tells; coefficients and turn of each frame that it ends.

        They are taken where the frame ends: what follows it belongs to the next one.
        """
        applied = []
        try:
            messages = [timed.message for timed in self._packet(packet).messages]
        except (self._parse_error, ValueError, IndexError, RecursionError):
            self.counts["unreadable"] += 1
            return []
        for message in messages:
            values = list(message)
            if message.address == "/VMC/Ext/Blend/Val":
                self._take_value(values)
            elif message.address == "/VMC/Ext/Blend/Apply":
                applied.append((self._coefficients(), self._turn))
            elif message.address == "/VMC/Ext/Bone/Pos" and values[:1] == [_HEAD]:
                self._take_turn(values[4:])
        return applied

    def _take_value(self, values: list[object]) -> None:
        name, value = values if len(values) == 2 else (None, None)
        if not isinstance(name, str) or not isinstance(value, float) or not math.isfinite(value):
            self.counts["not numbers"] += 1
            return
        if name.lower() not in self._arkit and name.lower() not in _VRM:
            self.counts["unknown blend shapes"] += 1
            return
        self.counts["values beyond 0..1"] += not 0 <= value <= 1
        self._told[name.lower()] = min(max(value, 0.0), 1.0)

    def _take_turn(self, values: list[object]) -> None:
        numbers = [float(v) for v in values if isinstance(v, float) and math.isfinite(v)]
        if len(numbers) != 4 or sum(v * v for v in numbers) < 1e-6:
            self.counts["not numbers"] += 1
            return
        x, y, z, w = numbers
        # Unity's x is the subject's right: mirrored, turns about y and z change their sign.
        turn = Rotation.from_quat([x, -y, -z, w]).as_rotvec()
        self._turn = torch.from_numpy(turn).float()

    def _coefficients(self) -> Float[Tensor, "52"]:
        """What is told by ARKit's names; by VRM's only where no such name has come."""
        row = torch.zeros(len(ARKIT_NAMES))
        perfect = self._told.keys() & self._arkit.keys()
        for name, value in self._told.items():
            parts = {self._arkit[name]: 1.0} if name in perfect else _VRM[name]
            if perfect and name not in perfect:
                continue
            for part, share in parts.items():
                place = ARKIT_NAMES.index(part)
                row[place] = max(float(row[place]), share * value)
        return row

    def close(self) -> None:
        """Listen no more."""
        self._datagrams.close()
