"""What of the demo subject can be chosen."""

from dataclasses import dataclass
from typing import Annotated, Literal

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import Between, CheckedOptions, FrameRate, Seed
from rgbavatar_ns.synthetic.performer.hair import HairStyle
from rgbavatar_ns.synthetic.performer.performance import Body


@dataclass(frozen=True)
class DemoConfig(CheckedOptions):
    """Size, length and difficulty of the demo subject's dataset."""

    image_size: Annotated[int, Between(8, 4096)] = 256
    """Width and height of the images in pixels."""
    num_frames: Annotated[int, Between(1, 100_000)] = 240
    """Frames in all."""
    num_test_frames: Annotated[int, Between(0, 100_000)] = 60
    """Held-out frames at the end; they combine expressions and poses as no other frame does."""
    seed: Seed = 0
    """Seed of the person's looks, the performance and the tracker's noise."""
    frames_per_second: FrameRate = 8.0
    """Frames per second of the performance; a second has some four syllables."""
    theta_noise: Annotated[float, Between(0, 100)] = 0.3
    """Strength of the tracker's noise: 1 is .01 on expression coefficients, .1 degrees on
    rotations (a third of a pixel at the crown of the default size) and .1 mm on translations; 0 is
    none. Images are never noisy."""
    supersampling: Annotated[int, Between(1, 16)] = 3
    """Rays per pixel along each axis where something begins or ends; elsewhere two rays."""
    wrinkles: Annotated[float, Between(0, 10)] = 1.0
    """Depth of the wrinkles that come with expressions; 0 leaves them out."""
    glasses: bool = True
    """Whether the person wears glasses."""
    body: Body = "none"
    """Whether shoulders and chest are in the picture, and what they do: sway a little, as the head
    alone does by default; keep still while the head turns; or lean to all sides."""
    hair: HairStyle = "short"
    """The person's hair, or a hat over it."""
    light: Literal["room", "head"] = "room"
    """What the lamps are fixed to: the room, in which the head turns, or the head itself, so that
    each point of it looks alike from everywhere but for highlights."""

    def __post_init__(self) -> None:
        """Refuse values out of range, and more held-out frames than there are."""
        super().__post_init__()
        if not 0 <= self.num_test_frames < self.num_frames:
            raise UserError(
                f"{self.num_test_frames} of {self.num_frames} frames cannot be held out.",
                "Ask for more frames (--num-frames), or hold out fewer (--num-test-frames).",
            )
