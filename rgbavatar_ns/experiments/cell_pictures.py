"""Some held-out frames as a cell's avatar shows them, kept with its result."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.drawing.compositing import composite_bytes
from rgbavatar_ns.drawing.contact_sheet import contact_sheet, labelled, scaled
from rgbavatar_ns.export import pictures, write_png

_FOLDER = "pictures"
_SHOWN = 3
_WHITE = (1.0, 1.0, 1.0)
_TILE_PX = 320
_WIDEST_PX = 2400
_QUALITIES = (90, 80, 65, 50, 35, 20)

CellPictures = Mapping[int, tuple[Path, Path]]
"""By the frame's number: the film's picture and the avatar's."""


def write_pictures(avatar: AvatarMethod, dataset: TrackedDataset, folder: Path) -> None:
    """Leave three held-out frames, evenly spread, over white in `folder`/pictures as PNG.

    Theta is as it was tracked. Of the film and of the avatar each; training frames where none are
    held out. Which ones depends on the dataset alone, so that all methods show the same.
    """
    place = folder / _FOLDER
    place.mkdir(parents=True, exist_ok=True)
    frames = list(dataset.test or dataset.train)
    # The middles of three equal parts.
    chosen = [frames[(2 * k + 1) * len(frames) // (2 * _SHOWN)] for k in range(_SHOWN)]
    for frame in dict.fromkeys(chosen):
        theta, camera = dataset.theta[frame : frame + 1], dataset.cameras.select([frame])
        (drawn,) = pictures(avatar, theta, camera, _WHITE)
        film = composite_bytes(dataset.read_image(frame), _WHITE)
        number = dataset.frame_index[frame]
        for kind, picture in (("film", film), ("avatar", drawn)):
            write_png(place / f"{kind}_{number:06d}.png", picture)


def read_pictures(folder: Path) -> dict[int, tuple[Path, Path]]:
    """What `write_pictures` left, in the film's order."""
    films = sorted((folder / _FOLDER).glob("film_*.png"))
    pairs = [(film, film.with_name(film.name.replace("film_", "avatar_", 1))) for film in films]
    return {
        int(film.stem.removeprefix("film_")): (film, avatar)
        for film, avatar in pairs
        if avatar.exists()
    }


def comparison(cells: Mapping[str, CellPictures], most_bytes: int) -> bytes | None:
    """A JPEG below `most_bytes`: a row for each frame that all cells have, the film on the left.

    cells: by the name above their column. None where they have no frame in common.
    """
    shown = sorted(set.intersection(*(set(found) for found in cells.values()))) if cells else []
    if not shown:
        return None
    first = next(iter(cells.values()))
    rows = []
    for number in shown:
        row = [("film", first[number][0])]
        row += [(name, found[number][1]) for name, found in cells.items()]
        rows.append([(name, _tile(path, len(row))) for name, path in row])
    tiles = [
        labelled(tile, name) if place == 0 else tile
        for place, row in enumerate(rows)
        for name, tile in row
    ]
    return _small_jpeg(contact_sheet(tiles, len(rows[0])), most_bytes)


def _tile(path: Path, in_a_row: int) -> UInt8[np.ndarray, "h w 3"]:
    """The picture, blue first, as high as the sheet's width leaves room for."""
    picture = cv2.imread(str(path))
    assert picture is not None, path
    height, width = picture.shape[:2]
    return scaled(picture, min(_TILE_PX / height, _WIDEST_PX / in_a_row / width))


def _small_jpeg(sheet: UInt8[np.ndarray, "H W 3"], most_bytes: int) -> bytes:
    """As good as fits; smaller where no quality makes it fit."""
    while True:
        for quality in _QUALITIES:
            encoded = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
            if len(encoded) < most_bytes:
                return encoded
        sheet = scaled(sheet, 0.7)
