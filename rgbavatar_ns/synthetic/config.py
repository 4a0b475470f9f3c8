"""What of the demo subject can be chosen."""

from dataclasses import dataclass

from rgbavatar_ns.errors import UserError


@dataclass(frozen=True)
class DemoConfig:
    """Size, length and difficulty of the demo subject's dataset."""

    image_size: int = 256
    """Width and height of the images in pixels."""
    num_frames: int = 240
    """Frames in all."""
    num_test_frames: int = 60
    """Held-out frames at the end; they combine expressions and poses as no other frame does."""
    seed: int = 0
    """Seed of the person's looks, the performance and the tracker's noise."""
    frames_per_second: float = 8.0
    """Frames per second of the performance; a second has some four syllables."""
    theta_noise: float = 0.3
    """Strength of the tracker's noise: 1 is .01 on expression coefficients, .1 degrees on
    rotations (a third of a pixel at the crown of the default size) and .1 mm on translations; 0 is
    none. Images are never noisy."""
    supersampling: int = 3
    """Rays per pixel along each axis where something begins or ends; elsewhere two rays."""
    wrinkles: float = 1.0
    """Depth of the wrinkles that come with expressions; 0 leaves them out."""
    glasses: bool = True
    """Whether the person wears glasses."""

    def __post_init__(self) -> None:
        if not 0 <= self.num_test_frames < self.num_frames:
            raise UserError(
                f"{self.num_test_frames} of {self.num_frames} frames cannot be held out.",
                "Ask for more frames, or hold out fewer.",
            )
        if self.image_size < 1 or self.supersampling < 1 or self.frames_per_second <= 0:
            raise UserError(
                "Image size, supersampling and frames per second must be positive.",
                "Leave them at their defaults.",
            )
