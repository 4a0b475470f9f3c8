"""High dynamic range (HLG, PQ), as phones film it, brought to the colours of ordinary screens."""

from functools import cache
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16

HdrTransfer = Literal["HLG", "PQ"]
_TRANSFERS: dict[int, HdrTransfer] = {18: "HLG", 16: "PQ"}
_BT709 = 1
_WHITE_NITS = 203.0
"""What white paper has in HDR (ITU-R BT.2408): it becomes 255, and so does what is brighter."""
_HLG_PEAK_NITS, _HLG_GAMMA = 1000.0, 1.2
_LUMINANCE_BT2020 = np.array([[0.2627, 0.6780, 0.0593]], np.float32)
# The inverse of ITU-R BT.2087's.
_BT2020_TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]],
    np.float32,
)


def hdr_transfer(color_trc: int) -> HdrTransfer | None:
    """The kind of HDR that a frame's transfer characteristic (ITU-T H.273) says it is, if any."""
    return _TRANSFERS.get(color_trc)


def hdr_to_srgb(
    image: UInt16[np.ndarray, "H W C"], transfer: HdrTransfer, color_primaries: int
) -> UInt8[np.ndarray, "H W C"]:
    """sRGB of the same colours, as far as it has them; a fourth channel, alpha, stays.

    Primaries (ITU-T H.273) other than BT.709's are taken for those of BT.2020, which HDR has.
    Ours, after BT.2100, tables 4 and 5: swscale's own way needs seconds for each film's opening.
    """
    # Tables of bytes are much the quickest; but to bytes swscale rounds too roughly for this.
    coded = cv2.convertScaleAbs(image, alpha=1 / 257)
    light = cv2.LUT(np.ascontiguousarray(coded[..., :3]), _light(transfer))
    if transfer == "HLG":
        gain = cv2.pow(cv2.transform(light, _LUMINANCE_BT2020), _HLG_GAMMA - 1)
        light = cv2.multiply(light, cv2.merge([gain, gain, gain]))
    if color_primaries != _BT709:
        light = cv2.transform(light, _BT2020_TO_BT709)
    # Roots of light are nearly in sRGB's steps.
    roots = cv2.convertScaleAbs(cv2.sqrt(np.maximum(light, 0)), alpha=255)
    return np.concatenate([cv2.LUT(roots, _srgb_of_roots()), coded[..., 3:]], axis=-1)


@cache
def _light(transfer: HdrTransfer) -> Float[np.ndarray, "256"]:
    """Linear light of each code; white is 1. HLG's is the scene's, before the display's gamma."""
    code = np.arange(256) / 255
    if transfer == "HLG":
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        scene = np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12)
        # The gamma is to come, and acts on this factor too.
        return (scene * (_HLG_PEAK_NITS / _WHITE_NITS) ** (1 / _HLG_GAMMA)).astype(np.float32)
    root = code ** (32 / 2523)
    ratio = np.maximum(root - 3424 / 4096, 0) / (2413 / 128 - 2392 / 128 * root)
    return (1e4 / _WHITE_NITS * ratio ** (16384 / 2610)).astype(np.float32)


@cache
def _srgb_of_roots() -> UInt8[np.ndarray, "256"]:
    """sRGB's codes (IEC 61966-2-1) for roots of linear light in 255 steps."""
    light = (np.arange(256) / 255) ** 2
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(255 * code).astype(np.uint8)
