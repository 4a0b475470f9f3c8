"""One tracked frame's picture: cropped, matted, faded out below the neck."""

from dataclasses import dataclass
from types import TracebackType

import numpy as np
from jaxtyping import Float, UInt8

from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.tracking.face.detector import CHIN, FOREHEAD
from rgbavatar_ns.tracking.image.crop import SquareCrop
from rgbavatar_ns.tracking.image.head_mask import HeadMask
from rgbavatar_ns.tracking.image.matting import PersonMatte, foreground_color, straight_rgba


@dataclass(frozen=True)
class MattedCrop:
    """A crop of one frame: the person's own colour and alpha in [0, 1]."""

    color: UInt8[np.ndarray, "S S 3"]
    alpha: Float[np.ndarray, "S S"]


class HeadPicture:
    """Cuts the person out of frames, in order: the matte first, the head's region when it is known.

    `keep_torso` keeps what lies below the neck.
    """

    def __init__(self, arrays: HeadArrays, keep_torso: bool) -> None:
        self._keep_torso = keep_torso
        self._region = HeadMask(arrays.faces, arrays.skinning_weights)
        self._matte = PersonMatte()

    def __enter__(self) -> "HeadPicture":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._matte.__exit__(kind, value, trace)

    def matted(self, image_rgb: UInt8[np.ndarray, "H W 3"], crop: SquareCrop) -> MattedCrop:
        """The crop with its background's share taken out of the colour."""
        picture = crop.apply(image_rgb)
        alpha = self._matte(picture) * crop.inside(image_rgb.shape[1], image_rgb.shape[0])
        return MattedCrop(foreground_color(picture, alpha), alpha)

    def region(
        self,
        crop: SquareCrop,
        vertices_px: Float[np.ndarray, "V 2"],
        landmarks_px: Float[np.ndarray, "478 2"],
    ) -> Float[np.ndarray, "S S"] | None:
        """What of the crop may stay; mesh vertices and FaceMesh landmarks in the frame's pixels."""
        if self._keep_torso:
            return None
        points = crop.points(landmarks_px[[FOREHEAD, CHIN]])
        return self._region(crop.points(vertices_px), points[0], points[1], crop.size)


def cut_out(
    matted: MattedCrop, region: Float[np.ndarray, "S S"] | None
) -> UInt8[np.ndarray, "S S 4"]:
    """Straight-alpha picture of what the matte holds in the region (None: everywhere)."""
    alpha = matted.alpha if region is None else matted.alpha * region
    return straight_rgba(matted.color, alpha)
