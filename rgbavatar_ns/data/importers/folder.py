"""A folder of somebody else's files: nothing outside of it is read, and every file is checked."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.reading import DamagedFileError, MissingFileError, load_arrays, load_json

IMPORTED_SUFFIXES = (".png", ".jpg", ".jpeg")
_NUMBER = re.compile(r"(?:.*\D)?(\d{1,15})")
_MAX_AXES = 4


@dataclass(frozen=True)
class Folder:
    """`allow_outside`: whether links and relative paths may lead out of `root`."""

    root: Path
    allow_outside: bool = False

    def given(self, place: Path) -> "Folder":
        """A folder that the user names, from where they stand; raises UserError if it is none."""
        if not place.is_dir():
            raise UserError(f"There is no folder {place}.", "Name the folder of the pictures.")
        return Folder(place, self.allow_outside)

    def path(self, relative: str | Path) -> Path:
        """A path in the folder; raises UserError where it leads out, through a link or `..`."""
        text = os.fspath(relative)
        if "\0" in text:
            raise UserError(f"A path in {self.root} holds a zero byte.", "Mend the data.")
        path = self.root / text
        real, top = Path(os.path.realpath(path)), os.path.realpath(self.root)
        if not self.allow_outside and not real.is_relative_to(top):
            raise UserError(
                f"'{text}' leads out of the folder {self.root}.",
                "Put the files into the folder, or consent with --allow-outside.",
            )
        return path

    def has(self, *relative: str) -> bool:
        """Whether all of these exist, wherever links lead."""
        return all(os.path.exists(self.root / name) for name in relative)

    def names(self, subfolder: str, suffixes: tuple[str, ...]) -> list[str]:
        """Files of these suffixes in a subfolder, in order; hidden ones are passed over."""
        folder = self.path(subfolder)
        return [
            name
            for name in (sorted(os.listdir(folder)) if os.path.isdir(folder) else ())
            if not name.startswith(".") and os.path.splitext(name)[1].lower() in suffixes
        ]

    def numbered(
        self, subfolder: str, suffixes: tuple[str, ...], ending: str = ""
    ) -> dict[int, Path]:
        """Files of a subfolder by the number before `ending` (as of 00001_mouth.png), in its order.

        Files without a number are passed over. Raises UserError where two have one number.
        """
        found: dict[int, Path] = {}
        twice: list[str] = []
        for name in self.names(subfolder, suffixes):
            stem = os.path.splitext(name)[0]
            match = _NUMBER.fullmatch(stem.removesuffix(ending))
            if match is None or not stem.endswith(ending):
                continue
            if int(match[1]) in found:
                twice.append(name)
            found[int(match[1])] = self.path(Path(subfolder) / name)
        if twice:
            raise UserError(
                f"{self.root / subfolder} holds several files of one number: {first_few(twice)}.",
                "Keep one of each, or put the others elsewhere.",
            )
        return dict(sorted(found.items()))


def number_of(path: str) -> int | None:
    """The number at the end of a file's name, its suffix left out."""
    match = _NUMBER.fullmatch(Path(path).stem)
    return int(match[1]) if match else None


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; raises UserError for anything else."""
    try:
        content = load_json(path)
    except DamagedFileError as error:
        raise UserError(f"{path} cannot be read: {error}.", "Copy or export it again.") from None
    if not isinstance(content, dict):
        raise UserError(f"{path} holds no JSON object.", "Copy or export it again.")
    return content


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file; raises UnusableFrameError where it is missing or damaged."""
    try:
        return load_arrays(path)
    except MissingFileError:
        raise UnusableFrameError("parameters that are missing") from None
    except DamagedFileError:
        raise UnusableFrameError("parameters that cannot be read") from None


def numbers(value: Any, count: int, what: str) -> Float[np.ndarray, "_"]:
    """`count` finite numbers, whatever batch axes of 1 they have; raises UnusableFrameError."""
    array = as_array(value, what)
    if array.dtype.kind not in "iuf" or array.size != count or count not in (1, *array.shape):
        raise UnusableFrameError(f"{what} that is not {count} numbers")
    return finite(array.reshape(count), what)


def number(value: Any, what: str) -> float:
    """One finite number by itself, as text files have it; raises UnusableFrameError."""
    if isinstance(value, list | tuple | np.ndarray):
        raise UnusableFrameError(f"{what} that is no single number")
    return float(numbers(value, 1, what)[0])


def matrix(value: Any, rows: int, columns: int, what: str) -> Float[np.ndarray, "R C"]:
    """A matrix of finite numbers, one batch axis of 1 allowed; raises UnusableFrameError."""
    array = as_array(value, what)
    if array.ndim == 3 and len(array) == 1:
        array = array[0]
    if array.dtype.kind not in "iuf" or array.shape != (rows, columns):
        raise UnusableFrameError(f"{what} that is not {rows} x {columns} numbers")
    return finite(array, what)


def as_array(value: Any, what: str) -> np.ndarray:
    """An array, or nested lists of numbers as one; raises UnusableFrameError for anything else.

    Neither text nor booleans are numbers, which numpy would take for some.
    """
    if value is None:
        raise UnusableFrameError(f"no {what}")
    if not _is_numeric(value):
        raise UnusableFrameError(f"{what} that is no list of numbers")
    try:
        return np.asarray(value)
    except (TypeError, ValueError, OverflowError):
        raise UnusableFrameError(f"{what} that is no list of numbers") from None


def _is_numeric(value: Any, axes: int = _MAX_AXES) -> bool:
    if isinstance(value, list | tuple):
        return axes > 0 and all(_is_numeric(item, axes - 1) for item in value)
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "iuf"
    number = isinstance(value, int | float | np.integer | np.floating)
    return number and not isinstance(value, bool)


def finite(array: np.ndarray, what: str) -> Float[np.ndarray, "*shape"]:
    """The array as float64; raises UnusableFrameError where a number is NaN or infinite."""
    array = array.astype(np.float64)
    # Anything beyond float32's reach would become infinite on the way.
    if not (np.abs(array) < 1e30).all():
        raise UnusableFrameError(f"NaN or infinity in {what}")
    return array
