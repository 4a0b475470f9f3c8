"""What a user of the viewer asks to see: one value, replaced as a whole."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.driving.live_drive import DrivenFrame

DrivenBy = Literal[
    "dataset frame", "viewer's time", "by hand", "driving sequence", "live performer"
]
PictureKind = Literal["avatar", "beside the film", "error", "alpha", "depth"]


@dataclass(frozen=True)
class ViewerState:
    """All that a picture depends on, beside the avatar and the camera."""

    driven_by: DrivenBy = "dataset frame"
    frame: int = 0
    theta_by_hand: Float[Tensor, "H"] | None = None
    sequence: Float[Tensor, "S H"] | None = None
    """Another person's performance in the avatar's theta."""
    sequence_frame: int = 0
    live: DrivenFrame | None = None
    """What `rgbavatar drive` shows now."""
    psi_by_hand: Float[Tensor, "K"] | None = None
    """Replaces the weight network's answer."""
    bases_used: int | None = None
    """Only the first so many bases count; all where it is None."""
    basis_alone: int | None = None
    """Show this basis alone, on the neutral frame."""
    gain: float = 1.5
    """By how much a basis that is shown alone is exaggerated."""
    picture: PictureKind = "avatar"
    mesh: bool = False
    centres: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the head in [0, 1]."""
    playing: bool = False
    frames_per_second: float = 25.0
