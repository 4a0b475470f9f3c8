"""The one way in which a frame's image is finished, for a clip and for a stream."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from rgbavatar_ns.tracking.face.detector import CHIN, FOREHEAD
from rgbavatar_ns.tracking.image.crop import SquareCrop
from rgbavatar_ns.tracking.image.head_mask import HeadMask, HeadOutline
from rgbavatar_ns.tracking.image.matting import foreground_color, straight_rgba

# Over which share of the picture's height a body fades out at its bottom.
_FADE = 0.04


@dataclass(frozen=True)
class MattedCrop:
    """A crop of one frame: the person's own colour and alpha in [0, 1].

    Both go on, as the frame's border says, where `inside` is False: there nobody filmed.
    """

    color: UInt8[np.ndarray, "S S 3"]
    alpha: Float[np.ndarray, "S S"]
    inside: Bool[np.ndarray, "S S"]

    @classmethod
    def of(
        cls,
        image_rgb: UInt8[np.ndarray, "S S 3"],
        matte: Float[np.ndarray, "S S"],
        inside: Bool[np.ndarray, "S S"],
        color_is_clean: bool = False,
        background: Float[np.ndarray, "S S 3"] | None = None,
    ) -> "MattedCrop":
        """The crop with its background's share taken out of the colour, unless that is clean."""
        color = image_rgb if color_is_clean else foreground_color(image_rgb, matte, background)
        return cls(color, matte, inside)


class CutOut:
    """Cuts what the head model has out of a matted crop: a head down to its neck, or the body too.

    A body ends where the picture does: there it fades out, over a few rows.
    """

    def __init__(self, arrays: HeadArrays) -> None:
        self._has_body = arrays.has_torso
        self._mask = HeadMask(arrays.faces, arrays.skinning_weights)

    def outline(
        self,
        crop: SquareCrop,
        vertices_px: Float[np.ndarray, "V 2"],
        landmarks_px: Float[np.ndarray, "478 2"],
    ) -> HeadOutline:
        """Where the head lies in the crop; mesh vertices and landmarks in the frame's pixels."""
        forehead, chin = crop.points(landmarks_px[[FOREHEAD, CHIN]])
        return self._mask.outline(crop.points(vertices_px), forehead, chin, crop.size)

    def __call__(self, matted: MattedCrop, outline: HeadOutline) -> UInt8[np.ndarray, "S S 4"]:
        """Straight-alpha image of what the matte holds of the head.

        Beyond the frame it is `UNFILMED_RGBA` where the head may be; what is cut off anyway is
        background there too.
        """
        alpha, may_be_head = matted.alpha, np.ones_like(matted.alpha)
        if self._has_body:
            alpha = alpha * fade_at_bottom(matted.inside)
        else:
            may_be_head = self._mask(outline, len(alpha))
            alpha = alpha * may_be_head
        image = straight_rgba(matted.color, alpha)
        image[~matted.inside] = 0
        image[~matted.inside & (may_be_head >= 0.5 / 255)] = UNFILMED_RGBA
        return image


def fade_at_bottom(inside: Bool[np.ndarray, "S S"]) -> Float[np.ndarray, "S 1"]:
    """1, and towards 0 over the last rows of what the frame shows."""
    size = len(inside)
    rows = np.flatnonzero(inside.any(1))
    last = rows[-1] + 1 if len(rows) else size
    share = np.clip((last - np.arange(size, dtype=np.float32) - 0.5) / (_FADE * size), 0, 1)
    return (share * share * (3 - 2 * share))[:, None]
