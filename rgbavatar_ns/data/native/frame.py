"""One tracked frame: what every importer, tracker and stream hands on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.kernels.types import PinholeCameras


@dataclass(frozen=True)
class TrackedFrame:
    """An image (straight alpha, `UNFILMED_RGBA` where nobody filmed), what the head did in it
    (radians, metres), and who saw it.

    index: number of the frame in its source, unique in a dataset.
    camera: exactly one (C = 1), of the image's size.
    camera_name, timestep: which of several cameras saw it, and the moment that they share.
    """

    index: int
    theta: Float[Tensor, "H"]
    camera: PinholeCameras
    image_rgba: UInt8[np.ndarray, "height width 4"]
    camera_name: str | None = None
    timestep: int | None = None
