"""What makes films of a person's body hard: things before, beside and behind it, and the camera.

Everything is laid under or over pictures of the procedural person, so that the truth stays known.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

Scene = Literal[
    "plain", "arms", "neighbour", "headrest", "patterned headrest", "shoulders", "cropped", "camera"
]
"""plain: a wall. arms: a forearm rises before the chest, then beside the head. neighbour: another
person's shoulder, which moves, in the picture's edge. headrest, dark or patterned: a chair's back
behind the shoulders, which keeps still. shoulders: the picture ends below them. cropped: it ends
at the chin. camera: it wanders."""

# Of the picture's side: where the bust's chin is, and what ends below its shoulders, how far the
# camera wanders, and how much of the picture is seen then.
_CHIN, _SHOULDERS, _WANDERS, _SHOWN = 0.46, 0.66, 0.03, 0.9
_SKIN, _SLEEVE, _CHAIR = (196.0, 158.0, 138.0), (150.0, 60.0, 50.0), (42.0, 40.0, 44.0)
_COAT = (70.0, 105.0, 70.0)
# Arms come and go within so much of the film, and a neighbour sways once in so much.
_RISE, _SWAY = (0.2, 0.75), 0.4

_Picture = Float[np.ndarray, "S S 3"]


@dataclass(frozen=True)
class FilmedPicture:
    """One frame, and the middle of what it shows, in pixels of the whole picture."""

    image_rgb: UInt8[np.ndarray, "h w 3"]
    middle_px: Float[np.ndarray, "2"]


def filmed(
    scene: Scene, images_rgba: Iterable[UInt8[np.ndarray, "S S 4"]], frames: int
) -> Iterator[FilmedPicture]:
    """The person's pictures, straight alpha, as the scene shows them."""
    for k, image in enumerate(images_rgba):
        done, size = k / max(1, frames - 1), len(image)
        picture = _wall(size)
        if scene in ("headrest", "patterned headrest"):
            _add_chair(picture, patterned=scene != "headrest")
        alpha = image[..., 3:].astype(np.float64) / 255
        picture = image[..., :3] * alpha + picture * (1 - alpha)
        if scene == "arms":
            _add_arm(picture, done)
        if scene == "neighbour":
            _add_neighbour(picture, done)
        yield _shown(scene, picture, done)


def _wall(size: int) -> _Picture:
    """Paint with a pattern, lit from one side."""
    row, column = np.mgrid[:size, :size] / size
    pattern = 15 * np.sin(40 * row) * np.sin(37 * column)
    wall = np.stack([90 + 60 * column, 110 + 40 * row, 130 - 30 * column], -1)
    return wall + pattern[..., None]


def _add_chair(picture: _Picture, patterned: bool) -> None:
    """A chair's high back: dark with a seam, or checked cloth."""
    size = len(picture)
    row, column = np.mgrid[:size, :size] / size
    inside = (np.abs(column - 0.5) < 0.3) & (row > 0.42)
    inside |= np.hypot(np.maximum(np.abs(column - 0.5) - 0.2, 0), row - 0.42) < 0.1
    cloth = 1 - 0.3 * (np.abs(np.abs(column - 0.5) - 0.25) < 0.004)
    if patterned:
        cloth = 2.0 + np.sign(np.sin(60 * column) * np.sin(60 * row))
    picture[inside] = (cloth[..., None] * _CHAIR)[inside]


def _add_arm(picture: _Picture, done: float) -> None:
    """A forearm that comes up from below, lies before the chest, and waves beside the head."""
    size = len(picture)
    start, end = _RISE
    up = np.clip((done - start) / (end - start), 0, 1)
    if not 0 < up < 1:
        return
    times = [0, 0.2, 0.5, 0.7, 0.9, 1]
    elbows = [(0.9, 1.2), (0.8, 1.1), (0.75, 1.05), (0.95, 1.05), (0.95, 1.1), (0.9, 1.3)]
    hands = [(0.7, 1.15), (0.5, 0.8), (0.35, 0.75), (0.8, 0.45), (0.72, 0.35), (0.8, 1.15)]
    elbow, hand = _between(up, times, elbows), _between(up, times, hands)
    hand[0] += 0.02 * np.sin(40 * up)
    row, column = np.mgrid[:size, :size] / size
    along, across = _beside(elbow, hand, row, column)
    sleeve = (across < 0.06) & (along > 0) & (along < 0.85)
    stripes = 0.8 + 0.3 * np.sin(2 * np.pi * 14 * along) * np.cos(2 * np.pi * across / 0.04)
    picture[sleeve] = (stripes[..., None] * _SLEEVE)[sleeve]
    palm = np.hypot(column - hand[0], row - hand[1]) < 0.06
    lines = 0.9 + 0.1 * np.sin(180 * (column - hand[0]))
    picture[palm] = (lines[..., None] * _SKIN)[palm]


def _add_neighbour(picture: _Picture, done: float) -> None:
    """A shoulder in a checked coat, which comes in from the right and leans to and fro."""
    size = len(picture)
    row, column = np.mgrid[:size, :size] / size
    x = 1.02 + 0.05 * np.sin(2 * np.pi * done / _SWAY)
    y = 0.75 + 0.03 * np.cos(2 * np.pi * done / _SWAY)
    coat = (np.hypot((column - x) / 0.22, (row - y) / 0.25) < 1) | (
        (row > y) & (np.abs(column - x) < 0.22)
    )
    checks = 1 + 0.35 * np.sign(np.sin(90 * (column - x)) * np.sin(90 * (row - y)))
    picture[coat] = (checks[..., None] * _COAT)[coat]


def _shown(scene: Scene, picture: _Picture, done: float) -> FilmedPicture:
    """What of the picture the film shows."""
    size = len(picture)
    left, top, width, height = 0, 0, size, size
    if scene == "cropped":
        height = 2 * round(size * _CHIN / 2)
        width, left = height, (size - height) // 2
    elif scene == "shoulders":
        height = 2 * round(size * _SHOULDERS / 2)
    elif scene == "camera":
        width = height = 2 * round(size * _SHOWN / 2)
        wander = _WANDERS * size * np.array([np.sin(9 * done), np.sin(13 * done + 1)])
        left, top = (round((size - width) / 2 + step) for step in wander.tolist())
    part = picture[top : top + height, left : left + width].clip(0, 255).astype(np.uint8)
    return FilmedPicture(part, np.array([left + width / 2, top + height / 2]))


def _between(
    at: float, times: list[float], places: list[tuple[float, float]]
) -> Float[np.ndarray, "2"]:
    """Where something is that goes from place to place."""
    x, y = np.array(places).T
    return np.array([np.interp(at, times, x), np.interp(at, times, y)])


def _beside(
    first: Float[np.ndarray, "2"],
    last: Float[np.ndarray, "2"],
    row: Float[np.ndarray, "S S"],
    column: Float[np.ndarray, "S S"],
) -> tuple[Float[np.ndarray, "S S"], Float[np.ndarray, "S S"]]:
    """How far along the way between two points (0 to 1) each pixel lies, and how far beside."""
    way = last - first
    x, y = column - first[0], row - first[1]
    along = (x * way[0] + y * way[1]) / (way @ way)
    return along, np.abs(x * way[1] - y * way[0]) / np.linalg.norm(way)
