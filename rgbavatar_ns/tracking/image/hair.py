"""Hair that the segmentation overlooks, told from the room by its colours.

Long hair beside a neck is left out in frame after frame where the room is busy or dark. But a room
that stands still is known wherever it shows, and what is not known there is the person, or what
the person has covered: of that, what has the colours of the person's hair is taken for hair.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from rgbavatar_ns.tracking.image.mixture import CHANNELS_TELL, OF_SIDE_PX, row_products

_Image = UInt8[np.ndarray, "S S 3"]
_Colors = Float[np.ndarray, "S S 3"]
_Values = Float[np.ndarray, "S S"]
_Mask = Bool[np.ndarray, "S S"]
_Pixels = UInt8[np.ndarray, "N 3"]
_LogDensity = Float[np.ndarray, "B B B"]

# The numbers below were chosen on two procedural people with long hair (seeds 101 and 102), in all
# rooms of `benchmarks/quality/rooms.py`. Colours are counted in bins of 8 levels.
_BINS, _BLUR_BINS = 32, 1.0
# The room has colours that were never seen there, shadows among them; hair hardly has.
_OTHER_HAIR, _OTHER_ROOM = 0.003, 0.2
# Hair is looked for well within the matte, this far up the face's height from its chin and beyond,
# and beside the face by this share of it; one pixel in seven tells its colours.
_WITHIN_PX, _UP, _BESIDE, _EVERY = 4.0, 0.7, 1 / 12, 7
# The room's colours are those within so many pixels of what is not known.
_AROUND_PX = 30.0
# Where the room shows, so often it is as its surroundings suggest, or as it is known; else it has
# any of its colours.
_AS_GUESSED, _AS_KNOWN = 0.5, 0.9
# A shadow leaves so much of the light at least.
_DARKEST_SHADE = 0.6
# Before a room that is known, hair is looked for within so many pixels of the segmentation.
_REACH_PX = 45.0
# A pixel alone says at most so much (log odds); its neighbours are asked in a window of so many
# pixels, and hair hangs together: so much more do they say.
_AT_MOST, _WINDOW_PX, _TOGETHER = 4.0, 7.0, 2.0
# What the segmentation is this sure of needs no other witness.
_SURE = 0.95


def _scaled(pixels: float, size: int) -> int:
    """Pixels of an image of `OF_SIDE_PX`, in one of this size."""
    return max(1, round(pixels * size / OF_SIDE_PX))


def hair_pixels(image_rgb: _Image, matte: _Values, face_px: Float[np.ndarray, "L 2"]) -> _Pixels:
    """Colours of what the matte holds around the upper face: hair, or a hat, or a bald scalp."""
    size = len(matte)
    hull = cv2.convexHull(face_px.astype(np.float32)).astype(np.int32)
    face = cv2.fillConvexPoly(np.zeros((size, size), np.uint8), hull, (1,))
    top, chin = float(face_px[:, 1].min()), float(face_px[:, 1].max())
    face = cv2.dilate(face, _disc(round(_BESIDE * (chin - top))))
    within = cv2.erode((matte > 0.9).astype(np.uint8), _disc(_scaled(_WITHIN_PX, size)))
    lowest = int(np.clip(chin - _UP * (chin - top), 0, size))
    return image_rgb[:lowest][((within > 0) & (face == 0))[:lowest]][::_EVERY]


def _disc(radius_px: int) -> UInt8[np.ndarray, "D D"]:
    side = 2 * max(1, radius_px) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


@dataclass(frozen=True)
class HairColors:
    """How often each colour is found in the person's hair, and in the room around the person.

    Logarithms of densities by cubic levels, over bins of red, green and blue.
    """

    hair: _LogDensity
    room: _LogDensity

    @classmethod
    def of(cls, hair: _Pixels, room: _Image, known: _Mask) -> "HairColors | None":
        """From pixels of hair, and the room where it is `known`; None where either is missing."""
        reach = cv2.dilate((~known).astype(np.uint8), _disc(_scaled(_AROUND_PX, len(known)))) > 0
        around = room[known & reach]
        if not len(hair) or not len(around):
            return None
        return cls(_log_density(hair, _OTHER_HAIR), _log_density(around, _OTHER_ROOM))


@dataclass(frozen=True)
class HairSearch:
    """Finds what a segmentation has left out of the hair in a room that stands still.

    At half the images' size: a segmentation knows no more, and the edges are found afterwards.
    """

    colors: HairColors
    guess: Float[np.ndarray, "s s 3"]
    """The room's colour, known or as its surroundings suggest it."""
    variance: Float[np.ndarray, "s s"]
    """Of the guess, levels squared."""
    known: Bool[np.ndarray, "s s"]
    inside: Bool[np.ndarray, "s s"]

    @classmethod
    def of(
        cls, colors: HairColors, guess: _Colors, variance: _Values, known: _Mask, inside: _Mask
    ) -> "HairSearch":
        """In a room of these colours; hair is looked for `inside` what was filmed."""
        whole = (_half(part.astype(np.float32)) == 1 for part in (known, inside))
        return cls(colors, _half(guess), _half(variance), *whole)

    def with_overlooked(self, coarse: _Values, image_rgb: _Image) -> _Values:
        """The segmentation together with the hair that it has left out."""
        few, size = _half(coarse), len(self.known)
        near = cv2.dilate((few > 0.5).astype(np.uint8), np.ones((_odd(2 * _REACH_PX, size),) * 2))
        asked = (~self.known | (near > 0)) & self.inside & (few < _SURE)
        places = np.flatnonzero(asked)
        color = _half(image_rgb).reshape(-1, 3)[places]
        variance, known = (one.reshape(-1)[places] for one in (self.variance, self.known))
        color_of, guess = color.astype(np.float32), self.guess.reshape(-1, 3)[places]
        # What the person shades is as the room is, and darker.
        shade = row_products(color_of, guess) / (row_products(guess, guess) + np.float32(1e-3))
        off = color_of - np.clip(shade, _DARKEST_SHADE, 1)[:, None] * guess
        as_guessed = row_products(off, off) / variance + 3 * np.log(2 * np.pi * variance)
        share, bins = np.where(known, _AS_KNOWN, _AS_GUESSED), tuple((color >> 3).T)
        room = np.logaddexp(
            np.log(share) - 0.5 * CHANNELS_TELL * as_guessed,
            np.log(1 - share) + CHANNELS_TELL * self.colors.room[bins],
        )
        odds = np.zeros((size, size), np.float32)
        hair = CHANNELS_TELL * self.colors.hair[bins]
        odds.flat[places] = np.clip(hair - room, -_AT_MOST, _AT_MOST)
        window = (_odd(_WINDOW_PX, size),) * 2
        weight = np.maximum(cv2.blur(asked.astype(np.float32), window), 1e-3)
        found = 1 / (1 + np.exp(-_TOGETHER * cv2.blur(odds, window) / weight))
        found = np.where(asked, found, 0).astype(np.float32)
        return np.maximum(coarse, cv2.resize(found, coarse.shape))


def _half(image: np.ndarray) -> np.ndarray:
    side = max(1, len(image) // 2)
    return cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)


def _odd(pixels: float, size: int) -> int:
    """The side of a window, in pixels of an image of `size`."""
    return 2 * max(1, round(pixels * size / OF_SIDE_PX / 2)) + 1


def _log_density(colors: _Pixels, anything: float) -> _LogDensity:
    """Of these colours, but for a share of `anything` at all."""
    count = np.zeros((_BINS,) * 3, np.float32)
    np.add.at(count, tuple((colors >> 3).T), 1)
    share = ndimage.gaussian_filter(count, _BLUR_BINS, mode="nearest") / len(colors)
    share = (1 - anything) * share + anything / _BINS**3
    return np.log(share / (256 / _BINS) ** 3)
