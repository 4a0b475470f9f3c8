"""Hair that the segmentation overlooks, told from the room by its colours.

Long hair beside a neck is left out in frame after frame where the room is busy or dark. But the
room is known wherever it shows, in a clip of a camera that stands or that a hand moves. What is not
known near the person is the person, what the person has covered, or something that moves: of that,
and of what differs from a known room, what has the colours of the person's hair is taken for hair.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from rgbavatar_ns.reading import DamagedFileError
from rgbavatar_ns.tracking.image.mixture import CHANNELS_TELL, OF_SIDE_PX, row_products

_Image = UInt8[np.ndarray, "S S 3"]
_Colors = Float[np.ndarray, "S S 3"]
_Values = Float[np.ndarray, "S S"]
_Mask = Bool[np.ndarray, "S S"]
_Pixels = UInt8[np.ndarray, "N 3"]
_Small = Float[np.ndarray, "s s"]

# The numbers below were chosen on procedural people with long hair or a hat (seeds 5 and 101 to
# 104), in all rooms of `benchmarks/quality/rooms.py` and with shadows on the wall. Lengths are
# pixels of an image of `OF_SIDE_PX`, and grow with it. Colours are counted in bins of 8 levels a
# channel; so many pixels tell them at least.
_BINS, _BLUR_BINS, _FEWEST = 32, 1.0, 200
# The room has colours that were never seen there, shadows among them; hair hardly has.
_OTHER_HAIR, _OTHER_ROOM = 0.003, 0.2
# The hair's colours are those well within the matte, this far up the face's height from its chin
# and higher, and beside the face by this share of it; one pixel in seven tells them.
_WITHIN_PX, _UP, _BESIDE, _EVERY = 4.0, 0.7, 1 / 12, 7
# The room's are those within so many pixels of what is not known.
_AROUND_PX = 30.0
# Where the room shows, so often it is as its surroundings suggest, or as it is known; else it has
# any of its colours. Of the former so much lies in shadow, which leaves so much of the light at
# least.
_AS_GUESSED, _AS_KNOWN = 0.5, 0.9
_SHADED, _DARKEST = 0.5, 0.6
# How far from the segmentation hair is looked for.
_REACH_PX = 60.0
# Where frames do not agree, so much speaks for the person (log odds). A pixel alone says at most so
# much; its neighbours are asked within so many pixels, and hair hangs together: so much more do
# they say.
_MOVES, _AT_MOST, _WINDOW_PX, _TOGETHER = 1.0, 4.0, 4.0, 2.0
# What the segmentation is this sure of needs no other witness.
_SURE = 0.95


def hair_pixels(
    image_rgb: _Image, matte: _Values, face_px: Float[np.ndarray, "L 2"], inside: _Mask
) -> _Pixels:
    """Colours of what the matte holds around the upper face: hair, or a hat, or a bald scalp.

    `inside` is where the image shows what was filmed.
    """
    size = len(matte)
    hull = np.rint(cv2.convexHull(face_px.astype(np.float32)) - 0.5).astype(np.int32)
    face = cv2.fillConvexPoly(np.zeros((size, size), np.uint8), hull, (1,)) > 0
    top, chin = float(face_px[:, 1].min()), float(face_px[:, 1].max())
    beside = _away_px(face) > _BESIDE * (chin - top)
    within = _away_px((matte <= 0.9) | ~inside) > _WITHIN_PX * size / OF_SIDE_PX
    lowest = int(np.clip(chin - _UP * (chin - top), 0, size))
    return image_rgb[:lowest][(within & beside)[:lowest]][::_EVERY]


@dataclass(frozen=True)
class HairColors:
    """How often each colour is found in the person's hair, and in the room around the person.

    Logarithms of densities by cubic levels, over bins of red, green and blue.
    """

    hair: Float[np.ndarray, "B B B"]
    room: Float[np.ndarray, "B B B"]

    @classmethod
    def of(cls, hair: _Pixels, room: _Image, known: _Mask, inside: _Mask) -> "HairColors | None":
        """From pixels of hair, and the room where it is `known`; None where either is too little.

        What is not known counts `inside` what was filmed.
        """
        unknown = ~known & inside
        reach_px = _AROUND_PX * len(known) / OF_SIDE_PX
        around = room[known & (_away_px(unknown) <= reach_px)] if unknown.any() else room[known]
        if min(len(hair), len(around)) < _FEWEST:
            return None
        return cls(_log_density(hair, _OTHER_HAIR), _log_density(around, _OTHER_ROOM))

    def checked(self) -> "HairColors":
        """Itself; raises DamagedFileError where a file has told something else."""
        for table in (self.hair, self.room):
            if table.shape != (_BINS,) * 3 or table.dtype != np.float32:
                raise DamagedFileError("its tables of colours have another form")
            if not np.isfinite(table).all():
                raise DamagedFileError("its tables of colours are not finite")
        return self


@dataclass(frozen=True)
class HairSearch:
    """Finds what a segmentation has left out of the hair before a known room.

    At half the images' size: it is told from the room by regions, and edges are found afterwards.
    """

    colors: HairColors
    variance: _Small
    """Of the room's colour as it is known or guessed, levels squared."""
    known: Bool[np.ndarray, "s s"]
    inside: Bool[np.ndarray, "s s"]
    """What was filmed."""
    moves: _Small
    """1 where the segmentation leaves something free that changes: likelier the person."""

    @classmethod
    def of(
        cls, colors: HairColors, variance: _Values, known: _Mask, inside: _Mask, moves: _Mask
    ) -> "HairSearch":
        """All parts of whole images."""
        few_known, few_inside, few_moves = (
            _half(part.astype(np.float32)) for part in (known, inside, moves)
        )
        # Means over parts of pixels are 1 but for rounding.
        return cls(colors, _half(variance), few_known > 0.99, few_inside > 0.99, few_moves)

    def with_overlooked(self, coarse: _Values, image_rgb: _Image, room: _Colors) -> _Values:
        """The segmentation together with the hair that it has left out.

        `room` is the room's colour in this frame's light, known or as its surroundings suggest it.
        """
        few, scale = _half(coarse), len(self.known) / OF_SIDE_PX
        asked = (_away_px(few > 0.5) < _REACH_PX * scale) & self.inside & (few < _SURE)
        if not asked.any():
            return coarse
        places = np.flatnonzero(asked)
        color = _half(image_rgb).reshape(-1, 3)[places]
        guess = _half(room.astype(np.float32)).reshape(-1, 3)[places]
        told = np.float32(CHANNELS_TELL) * self.colors.hair[_bins(color)]
        told -= self._of_room(color, guess, places)
        told += np.float32(_MOVES) * self.moves.reshape(-1)[places]
        odds = np.zeros(asked.shape, np.float32)
        odds.flat[places] = np.clip(told, -_AT_MOST, _AT_MOST)
        window = (2 * max(1, round(_WINDOW_PX * scale)) + 1,) * 2
        weight = np.maximum(cv2.blur(asked.astype(np.float32), window), np.float32(1e-3))
        found = 1 / (1 + np.exp(-np.float32(_TOGETHER) * cv2.blur(odds, window) / weight))
        found = np.where(asked, found, np.float32(0))
        return np.maximum(coarse, cv2.resize(found, coarse.shape))

    def _of_room(
        self, color: _Pixels, guess: Float[np.ndarray, "N 3"], places: Int[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N"]:
        """The logarithm of how likely these colours are where the room shows."""
        variance, known = (one.reshape(-1)[places] for one in (self.variance, self.known))
        width = np.log(np.float32(2 * np.pi) * variance)
        seen, squares = color.astype(np.float32), row_products(guess, guess) + np.float32(1)
        off = seen - guess
        light = -0.5 * (row_products(off, off) / variance + 3 * width)
        # What the person shades is as the room is, and darker by as much as may be.
        off = seen - np.clip(row_products(seen, guess) / squares, _DARKEST, 1)[:, None] * guess
        span = np.maximum((1 - _DARKEST) ** 2 * squares, 2 * np.pi * variance)
        shade = -0.5 * (row_products(off, off) / variance + 2 * width + np.log(span))
        of_guess = np.logaddexp(np.log(1 - _SHADED) + light, np.log(_SHADED) + shade)
        share = np.where(known, np.float32(_AS_KNOWN), np.float32(_AS_GUESSED))
        tell = np.float32(CHANNELS_TELL)
        return np.logaddexp(
            np.log(share) + tell * of_guess,
            np.log1p(-share) + tell * self.colors.room[_bins(color)],
        ).astype(np.float32)


def _away_px(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """How far each pixel lies from the mask; 0 on it."""
    away = cv2.distanceTransform(1 - mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(away, np.float32)


def _half(image: Float[np.ndarray, "S S *c"] | _Image) -> np.ndarray:
    side = max(1, len(image) // 2)
    return cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)


def _bins(colors: _Pixels) -> tuple[UInt8[np.ndarray, "N"], ...]:
    """Red, green and blue of their bins."""
    return tuple((colors // (256 // _BINS)).T)


def _log_density(colors: _Pixels, anything: float) -> Float[np.ndarray, "B B B"]:
    """Of these colours, but for a share of `anything` at all."""
    count = np.zeros((_BINS,) * 3, np.float32)
    np.add.at(count, _bins(colors), 1)
    share = ndimage.gaussian_filter(count, _BLUR_BINS, mode="reflect") / len(colors)
    share = (1 - anything) * share + anything / _BINS**3
    return np.log(share / (256 / _BINS) ** 3).astype(np.float32)
