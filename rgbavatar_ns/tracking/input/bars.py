"""Bars of one colour around a film, which are no part of it."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

# A line of pixels is a bar's where but few differ from its colour by more than compression does,
# and a bar ends where most pixels of a line differ clearly: an even wall ends at somebody's hair.
_EVEN_LEVELS, _UNEVEN_SHARE = 6, 0.02
_OTHER_LEVELS, _OTHER_SHARE = 10, 0.6
_EDGE_PX = 16
"""So many lines before an edge may be touched by compression: a macroblock's."""
_LEAST_PX, _LEAST_SHARE = 4, 0.01
_LEAST_FILM_PX = 32
# Bars come in pairs, which are equal but for so much: an even ceiling has no like below.
_UNLIKE_PX, _UNLIKE_SHARE = 4, 0.1
_ALONG = 400
"""So many pixels of a line are looked at."""


class Bars(NamedTuple):
    """How many pixels at each side of a picture are not the film's."""

    left: int = 0
    top: int = 0
    right: int = 0
    bottom: int = 0

    def within(self, size: tuple[int, int]) -> tuple[int, int]:
        """Width and height of what lies within."""
        return size[0] - self.left - self.right, size[1] - self.top - self.bottom

    def cut(self, image: UInt8[np.ndarray, "H W *C"]) -> UInt8[np.ndarray, "h w *C"]:
        """A view of what lies within, of a picture in the film's own size."""
        width, height = self.within((image.shape[1], image.shape[0]))
        return image[self.top : self.top + height, self.left : self.left + width]


NO_BARS = Bars()


def find_bars(pictures: Iterable[UInt8[np.ndarray, "_ _ _"]]) -> Bars:
    """The bars that all pictures [h, w, 3 or 4] of a film have; 0 at the sides that have none.

    Pictures of one colour all over (a film that fades in) and cut-outs tell nothing; pictures of
    several sizes have none. A bar is even along and across, 4 pixels and 1 % of the picture wide,
    ends in a straight edge, and has its like on the other side. Ours, because a bar below the
    shoulders was taken for the body.
    """
    seen = [one for one in map(_depths_and_edges, pictures) if one is not None]
    sizes = {one.size for one in seen}
    if len(sizes) != 1:
        return NO_BARS
    size = sizes.pop()
    found = [
        _bar([one.depths[side] for one in seen], [one.other[side] for one in seen], size[side % 2])
        for side in range(4)
    ]
    pairs = [_are_alike(found[side], found[(side + 2) % 4]) for side in range(4)]
    bars = Bars(*(px if alike else 0 for px, alike in zip(found, pairs)))
    return bars if min(bars.within(size)) >= _LEAST_FILM_PX else NO_BARS


def _are_alike(one_px: int, other_px: int) -> bool:
    apart = max(_UNLIKE_PX, _UNLIKE_SHARE * max(one_px, other_px))
    return min(one_px, other_px) > 0 and abs(one_px - other_px) <= apart


class _Seen(NamedTuple):
    """Of a picture's left, upper, right and lower side: how many lines are even, and of each line
    from there inwards the share of pixels of another colour between the even lines across it."""

    size: tuple[int, int]
    depths: list[int]
    other: list[Float[np.ndarray, "L"]]


def _depths_and_edges(image: UInt8[np.ndarray, "h w C"]) -> _Seen | None:
    """None for a picture of even fields alone, or one that is transparent somewhere."""
    if image[..., 3:].size and image[..., 3].min() < 255:
        return None
    height, width = image.shape[:2]
    across, down = (np.arange(0, px, max(1, px // _ALONG)) for px in (width, height))
    columns, rows = image[down, :, :3].swapaxes(0, 1), image[:, across, :3]
    sides = [_levels_from_border(lines) for lines in (columns, rows, columns[::-1], rows[::-1])]
    even = [(away > _EVEN_LEVELS).mean(1) <= _UNEVEN_SHARE for away in sides]
    if any(lines.all() for lines in even):
        return None
    left, top, right, bottom = depths = [int((~lines).argmax()) for lines in even]
    within = (down >= top) & (down < height - bottom), (across >= left) & (across < width - right)
    if not all(lines.any() for lines in within):  # Even fields side by side, and nothing between.
        return None
    other = [(away[:, within[k % 2]] > _OTHER_LEVELS).mean(1) for k, away in enumerate(sides)]
    return _Seen((width, height), depths, other)


def _levels_from_border(lines: UInt8[np.ndarray, "L P 3"]) -> Int[np.ndarray, "L P"]:
    """How far each pixel's channels are at most from the middle colour of the first line."""
    border = np.median(lines[0], axis=0).astype(np.int16)
    return np.abs(lines.astype(np.int16) - border).max(-1)


def _bar(depths: list[int], other: list[Float[np.ndarray, "L"]], side_px: int) -> int:
    """How deep one side's bar is: where the first picture's ends, and whether that is an edge."""
    depth = min(depths)
    edge = other[depths.index(depth)][depth : depth + _EDGE_PX + 1] > _OTHER_SHARE
    if not edge.any():
        return 0
    depth += int(edge.argmax())
    return depth if depth >= max(_LEAST_PX, _LEAST_SHARE * side_px) else 0
