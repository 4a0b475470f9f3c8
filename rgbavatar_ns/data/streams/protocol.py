"""What a stream of tracked frames is, wherever it comes from."""

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.png import decode_png_rgba, encode_png_rgba, png_header_size
from rgbavatar_ns.drawing.compositing import all_filmed
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, HeadModel, ThetaLayout, is_same_identity
from rgbavatar_ns.kernels.types import PinholeCameras

_LARGEST_IDENTITY = 100.0
_FARTHEST_CAMERA_M = 1000.0
_FOCAL_SIDES = (0.01, 10_000.0)
_FARTHEST_CENTRE_SIDES = 100.0
"""Beyond these a camera is a tracker's fault; sides are the image's longer one, in pixels."""
_PNG_SPARE_BYTES = 1 << 16


class Fault(NamedTuple):
    """Why a frame cannot be used: the name it is counted under, and what a user may read."""

    name: str
    reason: str

    @classmethod
    def unreadable(cls, error: UserError) -> "Fault":
        """Of an image that cannot be decoded."""
        return cls("unreadable", error.cause.removesuffix("."))

    def told(self, frame: "StreamedFrame") -> str:
        """For the user, of the first frame with this fault."""
        return f"Frame {frame.index} is left out: {self.reason}."


@dataclass(frozen=True)
class StreamSubject:
    """Who is filmed, the same for all frames; UserError where layout or identity do not fit."""

    arrays: HeadArrays
    identity: Float[Tensor, "I"]
    layout: ThetaLayout
    width: int
    height: int
    session: str = ""
    """Numbering of frames begins anew where a source comes back with another session."""
    client: str = ""
    """Known to one client alone: who brings it again comes back over a new connection."""

    def __post_init__(self) -> None:
        expected = HeadModel(self.arrays).layout
        if self.layout != expected:
            raise UserError(
                f"The stream has theta of {self.layout.size} values ({self.layout}), but the "
                f"head '{self.arrays.name}' takes {expected.size} ({expected}).",
                "Send theta in the layout of the head that the stream names.",
            )
        fits = self.identity.shape == (self.arrays.num_identity,)
        if not fits or not bool((self.identity.abs() <= _LARGEST_IDENTITY).all()):
            raise UserError(
                f"The stream's identity is not {self.arrays.num_identity} numbers within "
                f"{_LARGEST_IDENTITY:g}, which the head '{self.arrays.name}' takes.",
                "Send the identity coefficients of that head.",
            )
        if self.width < 1 or self.height < 1:
            raise UserError(
                f"The stream's images are said to be {self.width} x {self.height} pixels.",
                "Send the size of the images.",
            )

    def is_shaped_as(self, identity: Float[Tensor, "I"]) -> bool:
        """Whether the head's shape is this one, but for rounding: of another person it is not."""
        return is_same_identity(identity, self.identity)

    def fault(self, frame: "StreamedFrame") -> Fault | None:
        """Why the frame cannot be used, found without decoding its image; None if it can be."""
        if frame.theta.shape != (self.layout.size,):
            numbers = f"theta has {len(frame.theta)} numbers instead of {self.layout.size}"
            return Fault("theta of another size", numbers)
        if not bool(torch.isfinite(frame.theta).all()):
            return Fault("theta not finite", "theta holds NaN or infinity")
        absurd = self.layout.absurd(frame.theta)
        if absurd is not None:
            return Fault("theta absurd", f"theta's {absurd}")
        if not _is_plausible(frame.camera):
            return Fault("camera absurd", "its camera is too far away, or its lens impossible")
        size = frame.image_size
        if size is not None and size != (self.width, self.height):
            told = f"it has {size[0]} x {size[1]} pixels; the stream began with"
            return Fault("another resolution", f"{told} {self.width} x {self.height}")
        if frame.png is not None and len(frame.png) > self._longest_png:
            return Fault("unreadable", f"{len(frame.png)} bytes are too many for its image")
        return None

    @property
    def _longest_png(self) -> int:
        """16-bit RGBA that could not be packed; what is more would only fill the memory."""
        return 9 * self.width * self.height + _PNG_SPARE_BYTES


def _is_plausible(camera: PinholeCameras) -> bool:
    side = max(camera.width, camera.height)
    nearest, farthest = (share * side for share in _FOCAL_SIDES)
    return bool(
        (camera.world_to_camera[:, :3, 3].norm(dim=-1) <= _FARTHEST_CAMERA_M).all()
        and (camera.focal_px >= nearest).all()
        and (camera.focal_px <= farthest).all()
        and (camera.principal_point_px.abs() <= _FARTHEST_CENTRE_SIDES * side).all()
    )


@dataclass(frozen=True)
class StreamedFrame:
    """A tracked frame as it came, not checked yet; its image a PNG or pixels, straight alpha.

    camera: exactly one (C = 1), of the subject's image size.
    arrived_s: by the source's clock (time.monotonic()).
    """

    index: int
    theta: Float[Tensor, "_"]
    camera: PinholeCameras
    arrived_s: float
    session: str = ""
    png: bytes | None = field(default=None, kw_only=True)
    image_rgba: UInt8[np.ndarray, "height width 4"] | None = field(default=None, kw_only=True)
    marks_unfilmed: bool = field(default=True, kw_only=True)
    """Whether `UNFILMED_RGBA` says something in the PNG; an older dataset's is background."""

    def __post_init__(self) -> None:
        if (self.png is None) == (self.image_rgba is None):
            raise ValueError("A frame has its image either as a PNG or as pixels.")

    @property
    def image_size(self) -> tuple[int, int] | None:
        """Width and height as the image says, nothing is decoded; None where it is no PNG."""
        if self.image_rgba is not None:
            return self.image_rgba.shape[1], self.image_rgba.shape[0]
        return png_header_size(self.png or b"")

    def decode(self) -> TrackedFrame:
        """The frame with its pixels; raises UserError where the PNG is damaged or none."""
        image = self.image_rgba
        if image is None:
            image = decode_png_rgba(self.png or b"", f"frame {self.index}")
            image = image if self.marks_unfilmed else all_filmed(image)
        return TrackedFrame(self.index, self.theta, self.camera, image)

    def encoded(self) -> bytes:
        """The image as a PNG."""
        return encode_png_rgba(self.decode().image_rgba) if self.png is None else self.png


@runtime_checkable
class FrameStream(Protocol):
    """Gives the frames of one subject in the order of their arrival, each once.

    Called from one thread at a time; `close` from any.
    """

    @property
    def counts(self) -> Counter[str]:
        """What went wrong, by name: "unreadable", "reconnects", "no face" ..."""
        ...

    @property
    def keeps_frames(self) -> bool:
        """Whether frames that are not taken yet stay at the source.

        Else they are dropped when the queue behind it is full.
        """
        ...

    def subject(self, timeout_s: float) -> StreamSubject | None:
        """Who is filmed; None if that is not known after `timeout_s`."""
        ...

    def next(self, timeout_s: float) -> StreamedFrame | None:
        """The next frame; None if none has come after `timeout_s`, or the stream has ended."""
        ...

    @property
    def ended(self) -> bool:
        """Whether no frame will come any more."""
        ...

    def close(self) -> None:
        """Let go of files, sockets and devices; `next` returns None from now on."""
        ...


@runtime_checkable
class Rewindable(Protocol):
    """A stream that can begin in its middle, for a run that is resumed."""

    def go_on_after(self, index: int) -> None:
        """Begin behind the frame with this number; before the first `next`."""
        ...
