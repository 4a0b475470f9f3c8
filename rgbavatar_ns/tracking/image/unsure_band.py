"""Alpha where the segmentation leaves it open, from the colours of person and background.

The segmentation is trusted well inside and well outside of its outline. Between them each pixel's
colour is explained as a mixture of the person's colour near by and the background's, which a clean
plate knows or the surroundings suggest. How far a mixture tells more than the segmentation follows
from how different both colours are, and how much each of them varies.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from rgbavatar_ns.tracking.image.background import CleanPlate
from rgbavatar_ns.tracking.image.hair import HairSearch
from rgbavatar_ns.tracking.image.matting import in_one_piece, refined_matte
from rgbavatar_ns.tracking.image.mixture import (
    OF_SIDE_PX,
    PERSON_PX,
    Guess,
    mixed_alpha,
    row_products,
    spread_colors,
)
from rgbavatar_ns.tracking.image.room_view import Homography, laid_on

_Image = UInt8[np.ndarray, "S S 3"]
_Colors = Float[np.ndarray, "S S 3"]
_Values = Float[np.ndarray, "S S"]
_Mask = Bool[np.ndarray, "S S"]

# The numbers below were chosen on procedural people (`benchmarks/quality/mattes.py`, seeds 1 and
# 2, all rooms). Lengths are pixels of an image of `OF_SIDE_PX`, and grow with it.
# From the segmentation's outline: inside of the first everything is the person; the second is how
# far hair that stands off is looked for, if a plate tells it from the room.
_CORE_PX, _REACH_PX = 3.0, 45.0
# Without a plate nothing is looked for farther outside; beyond it the frame shows the background.
_NEAR_PX = 8.0
# Within how many pixels, and more, the background's mean colour is taken.
_ROOM_PX = (2, 6, 20, 60)
# Changes of light are smooth: every fourth pixel of every fourth row tells them.
_LIGHT_PX, _LIGHT_LEVELS, _LIGHT_EVERY = (10, 40), 12.0, 4
# Noise of a webcam after its compression, and what a guessed background's texture adds to it: at
# the border of what is known, and at most, some pixels away from it.
_NOISE_LEVELS, _GUESS_LEVELS, _TEXTURE = 2.0, 2.0, 0.1
_GUESS_FROM, _GUESS_TO, _GUESS_PX, _TEXTURE_PX = 0.3, 4.0, 4.0, 9
# Where nothing is known or guessed; and a pixel is known where all that it is made of is.
_ANY_LEVELS, _WHOLLY = 60.0, 0.999
# From so many times the noise on, a pixel may be hair that stands off; a pixel is no background, if
# all around it are as far off.
_MAYBE, _NOT_ROOM, _AROUND = 2.0, 4.0, np.ones((3, 3), np.uint8)
# So far off a known plate, what hangs on the person is of the person: shadows are not.
_OTHER = 12.0
# Mixtures lie on the line between both colours: no mixture has so large a squared sine to it, nor
# lies so far along it.
_ASIDE, _WHOLE = 0.1, 0.7
# Hair may be mixed with the room so far within the outline. It is where the hues of both differ by
# so many levels and so many times the noise, and less than such a share of the person's is there.
_DEEP_PX, _HUE_LEVELS, _HUE_SIGMAS, _PURE = 10.0, 45.0, 8.0, 0.85
# A guessed wall of so little texture and so much colour is as good as known, levels.
_SMOOTH_LEVELS, _COLORED_LEVELS = 8.0, 60.0
# How sure the segmentation is of alpha: at its outline, and away from it on either side.
_UNSURE, _SURE = 0.8, 0.15
_UNSURE_BESIDE, _UNSURE_ALONE = 0.15, 0.25
"""At its outline where a plate is known elsewhere, but not here; and where there is none."""
_INWARD_PX, _OUTWARD_PX = 4.0, 8.0
# The segmentation hovers off 0 and 1; an avatar would learn that as haze.
_HAZE = 0.15
# What is enclosed by the person and smaller is a fault of the segmentation, unless the plate shows
# through; shares of the image.
_HOLE_SHARE = 0.003


@dataclass(frozen=True)
class RoomColors:
    """What is behind the person everywhere: known, or guessed from what is known near by."""

    color: _Colors
    variance: _Values
    """Of the worst case of noise and guess, levels squared."""
    known: _Mask

    @classmethod
    def of(cls, color: _Image, known: _Mask, spread: _Values | float, coarser: int) -> "RoomColors":
        """Colours go on smoothly beyond what is known, and are the less sure the more texture."""
        weight = known.astype(np.float32)
        found = color.astype(np.float32)
        found[~known] = spread_colors(found, weight, _ROOM_PX, coarser)[~known]
        box = (_TEXTURE_PX, _TEXTURE_PX)
        mean = cv2.blur(found, box)
        texture = np.maximum(cv2.blur(found * found, box) - mean * mean, 0).mean(-1)
        away = cv2.distanceTransform(1 - known.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        away *= OF_SIDE_PX / len(color)
        guess = texture * (_TEXTURE * np.clip(away / _GUESS_PX, _GUESS_FROM, _GUESS_TO))
        guess = np.where(known, np.float32(spread) ** 2, guess + _GUESS_LEVELS**2)
        return cls(found, (guess + _NOISE_LEVELS**2).astype(np.float32), known)

    @classmethod
    def of_plate(cls, plate: CleanPlate) -> "RoomColors":
        """The room as a clip's plate knows it."""
        return cls.of(plate.color, plate.known, plate.spread, 1)

    def seen_from(self, to_here: Homography, elsewhere: _Mask) -> "RoomColors":
        """The same from where another picture was taken, whose pixels `to_here` leads here.

        What is `elsewhere` here is not known there.
        """
        here = (~elsewhere).astype(np.float32)
        known = laid_on(self.known * here, to_here, cv2.INTER_LINEAR) > _WHOLLY
        color = laid_on(self.color, to_here, cv2.INTER_CUBIC, cv2.BORDER_REPLICATE)
        # What no pixel of this room shows may have any colour.
        certainty = laid_on(here / self.variance, to_here, cv2.INTER_LINEAR)
        return RoomColors(color, 1 / np.maximum(certainty, np.float32(_ANY_LEVELS**-2)), known)


@dataclass(frozen=True)
class BandMatte:
    """Alpha, and the background's colour that goes with it."""

    alpha: _Values
    background: _Colors


def band_matte(
    image_rgb: _Image,
    coarse: _Values,
    plate: RoomColors | None = None,
    hair: HairSearch | None = None,
) -> BandMatte:
    """Alpha of the person in one piece, in [0, 1], from a segmentation that knows it coarsely.

    `plate` is the room as other frames know it; without it the frame's own surroundings stand for
    it. With it, `hair` finds what the segmentation has overlooked. Ours: difference matting (Smith
    and Blinn 1996) weighed as Bayesian matting does (Chuang 2001), with the segmentation as prior,
    on those pixels alone that it leaves open.
    """
    coarse = _without_holes(image_rgb, coarse, plate)
    image, inward = image_rgb.astype(np.float32), _inward(coarse)
    outside = inward < -_NEAR_PX
    room = (
        RoomColors.of(image_rgb, outside, 0.0, 2)
        if plate is None
        else _lit_as(image, plate, outside)
    )
    if plate is not None and hair is not None:
        coarse = hair.with_overlooked(coarse, image_rgb, room.color)
        inward = _inward(coarse)
        outside = inward < -_NEAR_PX
    apart = image - room.color
    differs = _squares(apart) / (3 * room.variance)
    deep = (inward > _DEEP_PX).astype(np.float32)
    towards = spread_colors(image, deep, PERSON_PX, 8) - room.color
    tinted = _tinted(apart, towards, room, inward) & (plate is not None)
    core = (inward > _CORE_PX) & ~tinted
    sure = core | (_unmixed(apart, towards, differs, inward) & ~tinted)
    if plate is not None:
        sure |= _revealed(differs, room, inward)
    band = ~sure & ~outside
    if plate is not None:
        band |= outside & (inward > -_REACH_PX) & (differs > _MAYBE**2)
    person = cv2.erode(sure.astype(np.uint8), _AROUND).astype(np.float32)
    open_px = np.flatnonzero(band)
    alpha = sure.astype(np.float32)
    prior = np.clip((coarse - _HAZE) / (1 - 2 * _HAZE), 0, 1)
    if plate is not None:
        # Where a body keeps still no frame shows the room beside it, and a shirt's pattern is no
        # mixture: there the image's own edges say where the outline goes.
        prior = np.where(room.known, prior, refined_matte(image_rgb, coarse))
    # Where the hue tells, the segmentation is not asked more than at its outline.
    depth = np.where(tinted, 0, inward).reshape(-1)[open_px]
    guess = Guess(prior.reshape(-1)[open_px], _precision(room, depth, open_px, plate is not None))
    alpha.reshape(-1)[open_px] = mixed_alpha(
        image, room.color, room.variance, person, guess, open_px
    )
    return BandMatte(in_one_piece(alpha, inward > 0), room.color)


def _tinted(apart: _Colors, towards: _Colors, room: RoomColors, inward: _Values) -> _Mask:
    """Pixels near the outline whose hue, whatever their light, has a share of the room's.

    Real hair lets a coloured wall through far within its outline; between greys light alone would
    have to tell, and hair shines. A guessed room has hues of its own: a white stripe on a blue
    shirt would pass for it. But a wall without texture is known well enough by its surroundings,
    if it is coloured itself.
    """
    asked = np.flatnonzero((inward > 0) & (inward < _DEEP_PX))
    hue, across, behind = (
        part - part.mean(1, keepdims=True)
        for part in (colors.reshape(-1, 3)[asked] for colors in (apart, towards, room.color))
    )
    length, variance = row_products(across, across), room.variance.flat[asked]
    plain = (variance < _SMOOTH_LEVELS**2) & (row_products(behind, behind) > _COLORED_LEVELS**2)
    telling = length > np.maximum(_HUE_LEVELS**2, _HUE_SIGMAS**2 * variance)
    telling &= room.known.flat[asked] | plain
    found = np.zeros(inward.shape, bool)
    found.flat[asked] = telling & (row_products(hue, across) < _PURE * length)
    return found


def _unmixed(apart: _Colors, towards: _Colors, differs: _Values, inward: _Values) -> _Mask:
    """What within the outline is neither the room nor a mixture of it with the person near by."""
    alone = cv2.erode((differs > _NOT_ROOM**2).astype(np.uint8), _AROUND) > 0
    asked = np.flatnonzero(alone & (inward > 0) & (inward <= _CORE_PX))
    off, across = (colors.reshape(-1, 3)[asked] for colors in (apart, towards))
    along, size = row_products(off, across), row_products(off, off)
    length = row_products(across, across) + np.float32(1e-3)
    aside = 1 - along * np.abs(along) / (length * size + np.float32(1e-3))
    found = np.zeros(inward.shape, bool)
    found.flat[asked] = (aside > _ASIDE) | (along > _WHOLE * length)
    return found


def _revealed(differs: _Values, room: RoomColors, inward: _Values) -> _Mask:
    """What hangs on the segmented person and is far from the plate's colour all over: the
    segmentation overlooked it, as it does hair before the ears, or a stripe of a shirt."""
    other = (differs > _OTHER**2) & room.known & (inward > -_NEAR_PX)
    alone = np.asarray(cv2.morphologyEx(other.astype(np.uint8), cv2.MORPH_OPEN, _AROUND)) > 0
    person = inward > 0
    count, found = cv2.connectedComponents((alone | person).astype(np.uint8))
    labels = np.asarray(found, np.int64)
    hangs = np.zeros(count, bool)
    hangs[labels[person]] = True
    whole = np.asarray(cv2.erode(alone.astype(np.uint8), _AROUND)) > 0
    return whole & hangs[labels]


def _precision(
    room: RoomColors, depth: Float[np.ndarray, "N"], open_px: Int[np.ndarray, "N"], has_plate: bool
) -> Float[np.ndarray, "N"]:
    """How much the segmentation counts at the open pixels: one over its variance."""
    unsure = np.full(len(depth), _UNSURE_ALONE, np.float32)
    if has_plate:
        unsure = np.where(room.known.reshape(-1)[open_px], _UNSURE, _UNSURE_BESIDE)
    away = np.clip(np.where(depth > 0, depth / _INWARD_PX, -depth / _OUTWARD_PX), 0, 1)
    return (unsure * (_SURE / unsure) ** away) ** -2


def _lit_as(image: _Colors, plate: RoomColors, outside: _Mask) -> RoomColors:
    """The plate as bright as this frame shows it: lamps flicker, cameras adapt, a person shades."""
    few = (slice(None, None, _LIGHT_EVERY),) * 2
    off = np.clip(image[few] - plate.color[few], -_LIGHT_LEVELS, _LIGHT_LEVELS)
    weight = (outside & plate.known)[few].astype(np.float32)
    shift = cv2.resize(spread_colors(off, weight, _LIGHT_PX, 2), outside.shape)
    return replace(plate, color=plate.color + shift)


def _without_holes(image_rgb: _Image, coarse: _Values, plate: RoomColors | None) -> _Values:
    """The segmentation without small holes, but for those that show the plate."""
    empty = (coarse <= 0.5).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(empty, connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] < _HOLE_SHARE * coarse.size
    if count < 3 or not small[1:].any():
        return coarse
    filled = coarse.copy()
    for label in np.flatnonzero(small[1:]) + 1:
        left, top, wide, high = stats[label, :4]
        if left == 0 or top == 0 or left + wide == len(coarse) or top + high == len(coarse):
            continue
        hole = labels == label
        if plate is not None and plate.known[hole].mean() > 0.5:
            off = image_rgb[hole].astype(np.float32) - plate.color[hole]
            if np.median((off**2).mean(1) / plate.variance[hole]) < _NOT_ROOM**2:
                continue
        filled[hole] = 1
    return filled


def _inward(coarse: _Values) -> _Values:
    """How far within the segmentation's outline each pixel lies, negative outside of it."""
    person = (coarse > 0.5).astype(np.uint8)
    inside, outside = (
        cv2.distanceTransform(one, cv2.DIST_L2, cv2.DIST_MASK_5) for one in (person, 1 - person)
    )
    return (inside - outside) * np.float32(OF_SIDE_PX / len(coarse))


def _squares(colors: _Colors) -> _Values:
    """Squared length over the channels."""
    return cv2.transform(cv2.multiply(colors, colors), np.ones((1, 3), np.float32))
