"""NeRF-style transforms.json files, as INSTA and VHAP write them: frames, splits, intrinsics."""

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.data.importers.folder import (
    IMPORTED_SUFFIXES,
    Folder,
    matrix,
    number,
    numbers,
    read_json,
)
from rgbavatar_ns.data.importers.frame_record import CameraRecord
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.source import Reading
from rgbavatar_ns.errors import UserError

INDEX_FILE = "transforms.json"
_SPLITS = ("train", "val", "test")
_MOST_SHARED = 100
"""Each frame gets them; nerfstudio writes some twenty."""
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def _file_of(split: str) -> str:
    return f"transforms_{split}.json"


@dataclass(frozen=True)
class Entry:
    """One frame of the files with what stands above all frames; the frame's own wins."""

    values: dict[str, Any]
    held_out: bool

    @property
    def name(self) -> str:
        """What to call it in a report."""
        return str(self.values.get("file_path", "a frame without file_path"))


def first_frame(folder: Folder) -> Mapping[str, Any] | None:
    """The index's first frame, to tell formats apart; None: no index, empty: it cannot be read."""
    for name in (INDEX_FILE, _file_of("train")):
        if folder.has(name):
            try:
                frames = read_json(folder.root / name).get("frames")
            except UserError:
                return {}
            first = frames[0] if isinstance(frames, list) and frames else None
            return first if isinstance(first, dict) else {}
    return None


def folders_outside(folder: Folder) -> list[Path]:
    """Where files lie that the frames name, but not in the folder: VHAP's united sequences do."""
    found = set()
    for name in (INDEX_FILE, *map(_file_of, _SPLITS)):
        content = read_json(folder.root / name) if folder.has(name) else {}
        frames = content.get("frames")
        for frame in frames if isinstance(frames, list) else ():
            values = frame.values() if isinstance(frame, dict) else ()
            paths = [value for value in values if isinstance(value, str) and "/" in value]
            found |= {os.path.dirname(path) for path in paths}
    outside = {name for name in found if os.path.normpath(name).startswith(("..", "/"))}
    return [folder.root / name for name in sorted(outside)]


def read_transforms(reading: Reading) -> tuple[list[Entry], bool]:
    """Every frame that the files name, once, and whether they tell which are held out.

    Held out are frames of transforms_test.json and transforms_val.json that are not in
    transforms_train.json: INSTA's val is the end of train, VHAP's is the held-out camera.
    """
    splits = {
        split: _frames(reading, _file_of(split))
        for split in _SPLITS
        if reading.folder.has(_file_of(split))
    }
    every = dict(_frames(reading, INDEX_FILE)) if reading.folder.has(INDEX_FILE) else {}
    has_split = "train" in splits and "test" in splits
    if splits and not has_split:
        there = ", ".join(map(_file_of, splits))
        raise UserError(
            f"{reading} has {there}, but not both {_file_of('train')} and {_file_of('test')}.",
            "Add the missing one, or remove all of them to hold out the last frames.",
        )
    for frames in splits.values():
        every = {**frames, **every}
    train = splits.get("train", {})
    held_out = {key for split in ("val", "test") for key in splits.get(split, ())} - train.keys()
    both = splits.get("test", {}).keys() & train.keys()
    if both:
        reading.report.note(
            f"{len(both)} frames stand both in {_file_of('train')} and {_file_of('test')}: they "
            "are trained on"
        )
    _tell_unnamed(reading, every.keys())
    if has_split:
        idle = every.keys() - train.keys() - held_out
        reading.report.leave_out("frames that no split names", sorted(idle))
        every = {key: values for key, values in every.items() if key not in idle}
    return [Entry(values, key in held_out) for key, values in every.items()], has_split


def _tell_unnamed(reading: Reading, named: Iterable[str]) -> None:
    """Images that lie beside named ones, but that no entry names."""
    named = {os.path.normpath(name) for name in named}
    for parent in {os.path.dirname(name) for name in named} - {""}:
        files = reading.folder.names(parent, IMPORTED_SUFFIXES)
        left = [name for name in files if os.path.join(parent, name) not in named]
        reading.report.leave_out("images without a record", left)


def _frames(reading: Reading, name: str) -> dict[str, dict[str, Any]]:
    """A file's frames by their image, each with the file's common values."""
    path = reading.folder.path(name)
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list):
        raise UserError(f"{path} has no list of frames.", "Export the data again.")
    shared = {key: value for key, value in content.items() if key != "frames"}
    if len(shared) > _MOST_SHARED:
        raise UserError(f"{path} says {len(shared)} things of all frames.", "Export it again.")
    found: dict[str, dict[str, Any]] = {}
    for place, frame in enumerate(frames):
        label = f"frame {place} of {name}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            reading.report.leave_out("entries without file_path", [label])
        elif frame["file_path"] in found:
            reading.report.leave_out("images named more than once", [frame["file_path"]])
        else:
            found[frame["file_path"]] = {**shared, **frame}
    return found


def camera_of(values: Mapping[str, Any], opengl: bool) -> CameraRecord:
    """The camera of a frame: `transform_matrix` is camera-to-world, in OpenGL or OpenCV axes."""
    camera_to_world = matrix(values.get("transform_matrix"), 4, 4, "transform_matrix")
    if not np.array_equal(camera_to_world[3], [0, 0, 0, 1]):
        raise UnusableFrameError("cameras whose matrix is no rotation and shift")
    if opengl:
        camera_to_world = camera_to_world @ _OPENGL_TO_OPENCV
    width, height = size_of(values)
    focal = [_focal(values, "x", (width, height)), _focal(values, "y", (width, height))]
    centre = [number(values.get(name), name) for name in ("cx", "cy")]
    return CameraRecord(inverse(camera_to_world), np.array(focal), np.array(centre))


def inverse(rigid: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Inverse of a rotation and shift; raises UnusableFrameError where it is singular."""
    try:
        return np.linalg.inv(rigid)
    except np.linalg.LinAlgError:
        raise UnusableFrameError("cameras whose matrix is no rotation and shift") from None


def size_of(values: Mapping[str, Any]) -> tuple[int, int]:
    """(width, height) of the frame's image."""
    width, height = numbers([values.get("w"), values.get("h")], 2, "w and h")
    if width < 1 or height < 1:
        raise UnusableFrameError("w and h that are not positive")
    return int(width), int(height)


def _focal(values: Mapping[str, Any], axis: str, size: tuple[int, int]) -> float:
    """In pixels: as it is written, else from the angle of view."""
    if f"fl_{axis}" in values:
        return number(values[f"fl_{axis}"], f"fl_{axis}")
    if f"camera_angle_{axis}" in values:
        angle = number(values[f"camera_angle_{axis}"], f"camera_angle_{axis}")
        if 0 < angle < math.pi:
            return 0.5 * size[axis == "y"] / math.tan(0.5 * angle)
    if axis == "y":
        return _focal(values, "x", size)
    raise UnusableFrameError("cameras without a focal length")
