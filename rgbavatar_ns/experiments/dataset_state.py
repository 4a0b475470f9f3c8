"""What a dataset is now, to know it again: figures of other frames are none of a sweep's."""

import os
from pathlib import Path

from rgbavatar_ns.data.importers import ImportOptions
from rgbavatar_ns.data.importers.convert import data_folders, source_places
from rgbavatar_ns.data.native.format import INDEX_FILE
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import digest, digest_of_file

_DESCRIBING = {".json", ".npy", ".npz"}
_SMALL_BYTES, _END_BYTES = 1 << 16, 1 << 12


def dataset_state(folder: Path) -> str:
    """A digest of all that a dataset is made of, in its own folder and beside it.

    Tables, arrays and small files count with their content, large ones (pictures) by their size
    and their ends, so that 5,000 frames take seconds; times do not, since a copy is the same
    data. Pictures at the folder's top are for people to look at. Raises UserError where one cannot
    be read.
    """
    places = [os.path.realpath(place) for place in source_places(folder, ImportOptions())]
    # Pictures of our own datasets may lie behind a link; what is imported refuses such by default.
    links = (folder / INDEX_FILE).is_file()
    return digest(
        part
        for place in places
        for below, names, _ in data_folders(place, follow_out=links)
        for path in (Path(below, name) for name in names)
        if not _is_to_look_at(path, Path(place))
        for part in (os.path.relpath(path, place), _content(path))
    )


def old_dataset_state(folder: Path) -> str:
    """As cells of before keep it: of the tables and arrays at the folder's top alone."""
    return digest(
        part
        for path in sorted(folder.glob("*"))
        if path.suffix in _DESCRIBING
        for part in (path.name, digest_of_file(path))
    )


def _is_to_look_at(path: Path, top: Path) -> bool:
    return path.parent == top and path.suffix not in {*_DESCRIBING, ".frame"}


def _content(path: Path) -> str:
    """A digest of a file, of a large one's ends."""
    try:
        size = path.stat().st_size
        if size > _SMALL_BYTES and path.suffix in _DESCRIBING:
            return digest_of_file(path)
        with path.open("rb") as file:
            if size <= _SMALL_BYTES:
                return digest([file.read()])
            first = file.read(_END_BYTES)
            file.seek(size - _END_BYTES)
            return digest([str(size), first, file.read(_END_BYTES)])
    except FileNotFoundError:
        return "missing"  # a link to nothing, which is nobody's data either
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}.", "Check the file.") from None
