"""What share of the person explains a pixel's colour, beside what the segmentation says of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int

_Colors = Float[np.ndarray, "S S 3"]
_Values = Float[np.ndarray, "S S"]
_Open = Float[np.ndarray, "N"]

# Chosen with the numbers of `unsure_band.py`, as they were. Lengths are pixels of an image of this
# side, and grow with it.
OF_SIDE_PX = 480
# Within how many pixels, and more, a colour's mean is taken: of the person, and of its darker part.
PERSON_PX, _DARKER_PX = (2, 5, 12, 40), (12, 40)
# Each wider mean only counts where the narrower one knows next to nothing.
_WIDER = 1e-3
# Of every so many pixels and rows one is asked for them.
_EVERY = 2
CHANNELS_TELL = 0.5
"""A pixel's channels err together: three say little more than one."""
# The darker part has to explain a colour better by so much (minus twice a log likelihood).
_DARKER_IS_RARE = 1.0
# Of 0, 1 and what lies between, the first two are the likelier the less a mixture tells: off .5 by
# so many more standard deviations' share. It is what makes the mean error least.
_DECIDED = 2.0


def spread_colors(
    values: Float[np.ndarray, "S S *channels"],
    weight: _Values,
    radii_px: Sequence[int],
    coarser: int,
) -> Float[np.ndarray, "S S *channels"]:
    """Weighted means within the narrowest radius that holds any weight, of each pixel.

    Radii are pixels of an image of 480; the means are taken at an image so many times `coarser`.
    """
    size = len(weight)
    few, scale = max(1, size // coarser), size / coarser / OF_SIDE_PX
    weighted = values * weight.reshape(size, size, *[1] * (values.ndim - 2))
    parts = [
        cv2.resize(part, (few, few), interpolation=cv2.INTER_AREA) for part in (weighted, weight)
    ]
    totals, share = [np.zeros_like(part) for part in parts], np.float32(1)
    for radius_px in radii_px:
        box = (2 * max(1, round(radius_px * scale)) + 1,) * 2
        for total, part in zip(totals, parts):
            total += share * cv2.blur(part, box)
        share *= np.float32(_WIDER)
    held = (totals[1] + np.float32(1e-12)).reshape(few, few, *[1] * (values.ndim - 2))
    return cv2.resize(totals[0] / held, (size, size))


def row_products(
    first: Float[np.ndarray, "N 3"], second: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N"]:
    """Scalar products; numpy's own sums over so few channels take several times as long."""
    return np.einsum("nc,nc->n", first, second)


@dataclass(frozen=True)
class Guess:
    """What is known of alpha at the open pixels before their colours are asked."""

    alpha: _Open
    precision: _Open
    """One over its variance."""


def mixed_alpha(
    image: _Colors,
    room: _Colors,
    room_variance: _Values,
    person: _Values,
    guess: Guess,
    open_px: Int[np.ndarray, "N"],
) -> _Open:
    """Alpha of the open pixels (flat indices), given where the `person` is for sure.

    A colour is explained with the person's near by, and with its darker part's farther around:
    hair that stands off before an ear has not the ear's colour. Both count as likely as they make
    what is seen. Ours: Bayesian matting (Chuang 2001) of two clusters.
    """
    few = _Sampled.of(image, room, person)
    light = cv2.transform(few.image, np.full((1, 3), 1 / 3, np.float32))
    mean = spread_colors(light, person[::_EVERY, ::_EVERY], _DARKER_PX, 2)
    pixels = _OpenPixels(
        image.reshape(-1, 3)[open_px],
        room.reshape(-1, 3)[open_px],
        room_variance.reshape(-1)[open_px] / np.float32(CHANNELS_TELL),
        guess,
        np.divmod(open_px, len(person)),
    )
    near = _explained(pixels, few, PERSON_PX)
    dark = _explained(pixels, replace(few, person=few.person * (light < mean)), _DARKER_PX)
    odds = 0.5 * (near.unlikely - dark.unlikely - _DARKER_IS_RARE)
    share = 1 / (1 + np.exp(-np.clip(odds, -30, 30)))
    alpha, precision = (
        a + share * (b - a) for a, b in ((near.alpha, dark.alpha), (near.precision, dark.precision))
    )
    decided = 1 + _DECIDED / np.sqrt(precision + guess.precision)
    return np.clip(0.5 + (alpha - 0.5) * decided, 0, 1)


@dataclass(frozen=True)
class _Sampled:
    """A part of the pixels: means and variances need no more."""

    image: _Colors
    room: _Colors
    person: _Values

    @classmethod
    def of(cls, *full: np.ndarray) -> "_Sampled":
        return cls(*(np.ascontiguousarray(part[::_EVERY, ::_EVERY]) for part in full))


@dataclass(frozen=True)
class _OpenPixels:
    """What is to be explained."""

    color: Float[np.ndarray, "N 3"]
    room: Float[np.ndarray, "N 3"]
    variance: _Open
    guess: Guess
    row_column: tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]]


@dataclass(frozen=True)
class _Explanation:
    alpha: _Open
    precision: _Open
    unlikely: _Open
    """Minus twice the log likelihood of the colours, but for what all explanations share."""


def _explained(pixels: _OpenPixels, few: _Sampled, radii_px: Sequence[int]) -> _Explanation:
    """The open pixels as mixtures of the mean colour of the person near by and the room."""
    color = spread_colors(few.image, few.person, radii_px, 1)
    # How far the person's own colours differ towards the room's: hair that shines is no mixture
    # with a coloured wall. About the mean at each place, since a wide window's own mean would make
    # far strands unsure.
    towards, own = color - few.room, few.image - color
    along = _dot(own, towards) ** 2 / (_squares(towards) + np.float32(1e-3))
    varies = cv2.merge([along, np.maximum(_squares(own) - along, 0)])
    varies = spread_colors(varies, few.person, radii_px, 1)
    row, column = (place // _EVERY for place in pixels.row_column)
    varies, beside = varies[row, column].T
    off, across, guess = pixels.color - pixels.room, color[row, column] - pixels.room, pixels.guess
    length = row_products(across, across) + np.float32(1e-3)
    share = row_products(off, across) / length
    alpha, precision = guess.alpha, guess.precision
    # The person's variance counts as far as the person is seen, which is to be found.
    for _ in range(2):
        precision = length / (pixels.variance + alpha * alpha * varies)
        total = precision + guess.precision
        alpha = np.clip((precision * share + guess.precision * guess.alpha) / total, 0, 1)
    surprise = (share - guess.alpha) ** 2 * precision * guess.precision
    aside = np.maximum(row_products(off, off) - share * share * length, 0)
    aside = aside / (pixels.variance + alpha * alpha * beside / 2)
    return _Explanation(alpha, precision, surprise / (precision + guess.precision) + aside)


def _dot(first: _Colors, second: _Colors) -> _Values:
    """Scalar product over the channels."""
    return cv2.transform(cv2.multiply(first, second), np.ones((1, 3), np.float32))


def _squares(colors: _Colors) -> _Values:
    return _dot(colors, colors)
