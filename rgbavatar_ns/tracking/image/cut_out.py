"""The one way in which a frame's image is finished, for a clip and for a stream."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from rgbavatar_ns.tracking.face.detector import CHIN, FOREHEAD
from rgbavatar_ns.tracking.image.body_end import BodyEnd
from rgbavatar_ns.tracking.image.head_mask import HeadMask, HeadOutline
from rgbavatar_ns.tracking.image.matting import (
    STRAY_ALPHA,
    foreground_color,
    in_one_piece,
    straight_rgba,
)


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
    """Cuts what the head model has out of a matted crop: a head down to its neck, or, with where
    its `body_end` is, the body too.
    """

    def __init__(self, arrays: HeadArrays, body_end: BodyEnd | None = None) -> None:
        self._body_end = body_end
        self._mask = HeadMask(arrays.faces, arrays.skinning_weights)

    def outline(
        self,
        size: int,
        vertices_px: Float[np.ndarray, "V 2"],
        landmarks_px: Float[np.ndarray, "478 2"],
    ) -> HeadOutline:
        """Where the head lies in a crop of this size; mesh vertices and landmarks in its pixels."""
        forehead, chin = landmarks_px[[FOREHEAD, CHIN]]
        return self._mask.outline(vertices_px, forehead, chin, size)

    def __call__(
        self, matted: MattedCrop, outline: HeadOutline, vertices_px: Float[np.ndarray, "V 2"]
    ) -> UInt8[np.ndarray, "S S 4"]:
        """Straight-alpha image of what the matte holds of the head; mesh in the crop's pixels.

        Beyond the frame it is `UNFILMED_RGBA` where the head may be; what is cut off anyway is
        background there too.
        """
        alpha, may_be_head = matted.alpha, np.ones_like(matted.alpha)
        if self._body_end is not None:
            shown = self._body_end.shown(vertices_px, len(alpha))
            alpha = _without_what_hung_below(alpha, shown, outline.silhouette > 0.5) * shown
        else:
            may_be_head = self._mask(outline, len(alpha))
            alpha = alpha * may_be_head
        image = straight_rgba(matted.color, alpha)
        image[~matted.inside] = 0
        image[~matted.inside & (may_be_head >= 0.5 / 255)] = UNFILMED_RGBA
        return image


def _without_what_hung_below(
    alpha: Float[np.ndarray, "S S"],
    shown: Float[np.ndarray, "S S"],
    head: Bool[np.ndarray, "s s"],
) -> Float[np.ndarray, "S S"]:
    """A matte without pieces that hang together with the head by what is not `shown` alone.

    A lamp beside a sleeve is nobody's, nor is what of it still fades out below.
    """
    whole = shown > 0.5
    kept = in_one_piece(np.where(whole, alpha, 0), head)
    dropped = (whole & (alpha > STRAY_ALPHA) & (kept < alpha)).any(0)
    stays = (whole & (kept > STRAY_ALPHA)).any(0)
    return np.where(whole, kept, np.where(dropped & ~stays, 0, alpha))
