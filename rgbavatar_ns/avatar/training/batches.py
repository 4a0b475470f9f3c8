"""What a training step sees: tracked frames, or the numbers of frames that lie on the device."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from rgbavatar_ns.kernels import PinholeCameras


@dataclass(frozen=True)
class TrainingBatch:
    """B tracked frames: theta, cameras (one, or one an image) and straight-alpha images."""

    theta: Float[Tensor, "B H"]
    cameras: PinholeCameras
    images_rgba: UInt8[Tensor, "B H_px W_px 4"] | Float[Tensor, "B H_px W_px 4"]
    background: Float[Tensor, "B 3"] | None = None
    """Colours behind the images; where None, random ones of seed and step."""
    position: Int[Tensor, "B"] | None = None
    """The frames' places in the dataset; refined tracking asks for them."""


@dataclass(frozen=True)
class ChosenFrames:
    """A batch by the numbers of its frames among those that lie on the device."""

    rows: list[int]
    background: Float[Tensor, "B 3"]
    """In main memory."""


@dataclass(frozen=True)
class DeviceFrames:
    """All frames that are trained on, on one device; one camera, or one a frame."""

    theta: Float[Tensor, "F H"]
    cameras: PinholeCameras
    images_rgba: UInt8[Tensor, "F height width 4"]
    room: UInt8[Tensor, "R height width 4"] | None = None
    """The memory that the images are the beginning of, where it goes on behind them."""

    def batch(self, rows: Sequence[int]) -> TrainingBatch:
        """These frames by themselves."""
        chosen, shared = list(rows), len(self.cameras.focal_px) == 1
        cameras = self.cameras if shared else self.cameras.select(chosen)
        return TrainingBatch(self.theta[chosen], cameras, self.images_rgba[chosen])

    def joined(self, others: "DeviceFrames") -> "DeviceFrames":
        """These frames, then others of the same size, each with a camera.

        The images lie in `room` where that holds them all: a film's are not copied.
        """
        count, room = len(self.theta) + len(others.theta), self.room
        if room is not None and len(room) >= count:
            images = room[:count]
            images[len(self.theta) :] = others.images_rgba
        else:
            images = torch.cat([self.images_rgba, others.images_rgba])
        return DeviceFrames(
            torch.cat([self.theta, others.theta]),
            each_its_own(self.cameras, len(self.theta)).joined(others.cameras),
            images,
        )


def each_its_own(cameras: PinholeCameras, num_frames: int) -> PinholeCameras:
    """One camera a frame, where there may be one for all."""
    return cameras.select([0] * num_frames) if len(cameras.focal_px) == 1 else cameras
