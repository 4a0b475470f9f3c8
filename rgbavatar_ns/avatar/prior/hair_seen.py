"""Where pictures show hair, and how much its strands stand out."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from rgbavatar_ns.avatar.prior.mesh_field import haired_for_certain
from rgbavatar_ns.avatar.prior.placed_mesh import PlacedMesh, covered_pixels
from rgbavatar_ns.drawing.compositing import unfilmed_pixels
from rgbavatar_ns.head import HeadArrays

_BAND_M = 1e-3, 6e-3
"""Standard deviations of the blurs between which strands and locks are measured."""
_RIM_M = 4e-3
"""Along the person's outline, where mattes are soft, nothing is measured."""
_LEAST_PX, _LEAST_BLUR_PX = 50, 0.5
"""Of hair, for a picture to tell of it; and the smallest blur."""
_DARKEST, _MOST_CONTRAST = 25.0, 0.25
"""Levels of light below which noise would count, and what a striped hat has more of than hair."""
_OF_MEDIAN = 1.4826
"""Standard deviation over median of the absolute values, of a normal distribution."""


def haired_pixels(
    arrays: HeadArrays,
    seen: PlacedMesh,
    px: Float[np.ndarray, "V 2"],
    faces: Int[np.ndarray, "F 3"],
    width: int,
    height: int,
) -> UInt8[np.ndarray, "height width"]:
    """1 where a mesh whose vertices are at `px` shows a part of the head that may have hair."""
    first, second, third = px[faces].transpose(1, 2, 0)
    side, other = second - first, third - first
    # As y goes down in pictures, what shows its outer side turns to the left.
    towards = faces[side[0] * other[1] < side[1] * other[0]]
    haired = haired_for_certain(arrays).numpy()[towards].all(1)
    hair = covered_pixels(px, towards[haired], width, height)
    # Only what lies there may be before it: to draw every face takes thirty milliseconds.
    column, row = px[towards].clip(0, [width - 1, height - 1]).astype(int).transpose(2, 0, 1)
    there = haired | (hair[row, column] > 0).any(1)
    towards, haired = towards[there], haired[there]
    from_afar = np.argsort(-seen.places_m[:, 2].numpy()[towards].mean(1))
    return covered_pixels(px, towards[from_afar], width, height, haired[from_afar])


def hair_contrast(
    arrays: HeadArrays,
    images_rgba: UInt8[np.ndarray, "B height width 4"],
    placed: Sequence[PlacedMesh],
    moved_px: Sequence[Float[np.ndarray, "V 2"]],
    faces: Int[np.ndarray, "F 3"],
) -> float:
    """How far light varies over strands and locks of hair, a share of it: 0 where none are seen.

    The median of frames and, within one, of pixels, as borders of hair are no strands.
    """
    found = [
        contrast
        for image, seen, px in zip(images_rgba, placed, moved_px)
        if (contrast := _contrast_in(image, seen, px, arrays, faces)) is not None
    ]
    return min(float(np.median(found)), _MOST_CONTRAST) if found else 0.0


def _contrast_in(
    image: UInt8[np.ndarray, "height width 4"],
    seen: PlacedMesh,
    px: Float[np.ndarray, "V 2"],
    arrays: HeadArrays,
    faces: Int[np.ndarray, "F 3"],
) -> float | None:
    """One frame's, or None where it shows no hair."""
    height, width = image.shape[:2]
    px_of_metre = seen.px_of_metre
    person = ((image[..., 3] > 127) & ~unfilmed_pixels(image)).astype(np.uint8)
    depth_m = cv2.distanceTransform(person, cv2.DIST_L2, 5) / px_of_metre
    hair = (depth_m > _RIM_M) & (haired_pixels(arrays, seen, px, faces, width, height) > 0)
    # No finer than is looked at, or large pictures take seconds.
    times = max(1, int(_BAND_M[0] * px_of_metre))
    weight = hair.astype(np.float32)
    light = image[..., :3].mean(2, dtype=np.float32) * weight
    both = np.dstack([light, weight])
    both = cv2.resize(both, (-(-width // times), -(-height // times)), interpolation=cv2.INTER_AREA)
    fine, coarse = (
        _blurred_within(both, max(metres * px_of_metre / times, _LEAST_BLUR_PX))
        for metres in _BAND_M
    )
    within = both[..., 1] > 0.5
    if within.sum() < _LEAST_PX:
        return None
    apart = float(np.median(np.abs(fine - coarse)[within]))
    return _OF_MEDIAN * apart / max(float(np.median(coarse[within])), _DARKEST)


def _blurred_within(
    values_and_weight: Float[np.ndarray, "height width 2"], sigma_px: float
) -> Float[np.ndarray, "height width"]:
    blurred = cv2.GaussianBlur(values_and_weight, (0, 0), sigma_px)
    return blurred[..., 0] / blurred[..., 1].clip(1e-3)
