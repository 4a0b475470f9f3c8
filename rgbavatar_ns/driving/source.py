"""Who performs, frame by frame: what every source of a live performance gives."""

from collections import Counter
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.head import HeadArrays, ThetaLayout


@dataclass(frozen=True)
class PerformanceFrame:
    """What a performer did at one moment: theta of the source's head, or ARKit's coefficients."""

    index: int
    """Rises from frame to frame; what the source left out is missing."""
    captured_s: float
    """When the picture was taken or the packet came, by time.monotonic()."""
    time_s: float
    """By the source's own clock, for its speed."""
    theta: Float[Tensor, "G"] | None = None
    """In the layout of `PerformerHead`."""
    coefficients: Float[Tensor, "52"] | None = None
    """In the order of `ARKIT_NAMES`."""
    head_rotation: Float[Tensor, "3"] | None = None
    """With `coefficients`: axis-angle in radians, x the subject's left, y up, z out of the face."""
    image_rgb: UInt8[np.ndarray, "height width 3"] | None = None
    """The source's own picture, where it has one, at the height that was asked of the source."""


@dataclass(frozen=True)
class PerformerHead:
    """The head whose theta a source gives."""

    layout: ThetaLayout
    arrays: HeadArrays


@runtime_checkable
class PerformanceSource(Protocol):
    """A performance as it comes. One thread calls it; `close` may come from another."""

    @property
    def head(self) -> PerformerHead | None:
        """The head of `PerformanceFrame.theta`; None where the source gives coefficients."""
        ...

    @property
    def ended(self) -> bool:
        """Whether no frame will follow."""
        ...

    @property
    def counts(self) -> Counter[str]:
        """What was left out, by the reason."""
        ...

    @property
    def waits_for(self) -> str:
        """What the user can do where nothing comes: an address, a face before the camera."""
        ...

    def next(self, timeout_s: float) -> PerformanceFrame | None:
        """The newest frame that has not been given yet, or None after so many seconds."""
        ...

    def close(self) -> None:
        """Let go of files, cameras and sockets."""
        ...
