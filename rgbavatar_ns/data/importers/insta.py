"""INSTA: transforms.json with OpenCV cameras, and what metrical-tracker knew or its meshes tell."""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.data.importers.flame_parameters import flame_for, padded
from rgbavatar_ns.data.importers.folder import Folder, number_of
from rgbavatar_ns.data.importers.frame_files import FLAME_VERSION, read_frame_files
from rgbavatar_ns.data.importers.frame_folders import CHECKPOINTS
from rgbavatar_ns.data.importers.frame_images import FrameImage
from rgbavatar_ns.data.importers.frame_record import FrameRecord
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.mesh_fit import fit_meshes
from rgbavatar_ns.data.importers.source import Reading, Source, assemble
from rgbavatar_ns.data.importers.transforms import (
    INDEX_FILE,
    Entry,
    camera_of,
    first_frame,
    read_transforms,
    size_of,
)
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.flame import EXPRESSIONS
from rgbavatar_ns.reading import read_file

_HELD_OUT = 350
_CAMERA_TOLERANCE = 1e-3
_EXPRESSION_BYTES = 1 << 20


_Parameters = tuple[
    HeadArrays, Float[np.ndarray, "_"], dict[int, dict[str, Float[np.ndarray, "_"]]]
]
"""Head model, identity, and theta by frame number."""


def is_insta(folder: Folder) -> bool:
    """A transforms.json whose frames name no VHAP parameters, beside meshes or `.frame` files."""
    frame = first_frame(folder)
    if frame is None or "flame_param_path" in frame:
        return False
    return bool({"exp_path", "mesh_path"} & frame.keys()) or folder.has(CHECKPOINTS)


def read_insta(reading: Reading) -> Source:
    """INSTA data with `.frame` files, or without: then jaw, eyes and eyelids are fitted to meshes.

    Images are RGBA with soft alpha. The last 350 frames are held out where no file tells.
    """
    listed, has_split = read_transforms(reading)
    entries: dict[int, Entry] = {}
    for entry in listed:
        with reading.report.frame(entry.name):
            number = number_of(entry.name)
            if number is None:
                raise UnusableFrameError("images without a number")
            if number in entries:
                raise UnusableFrameError("images of the same number")
            entries[number] = entry
    files = reading.folder.numbered(CHECKPOINTS, (".frame",))
    arrays, identity, theta = (
        _from_frames(reading, entries, files) if files else _from_meshes(reading, entries)
    )
    records = []
    for number, entry in entries.items():
        with reading.report.frame(entry.name):
            if number in theta:
                frame_image = FrameImage(reading.folder.path(entry.name))
                camera = camera_of(entry.values, opengl=False)
                size = size_of(entry.values)
                records.append(FrameRecord(number, frame_image, theta[number], camera, size))
    held_out = {number for number, entry in entries.items() if entry.held_out}
    return assemble(reading, records, arrays, identity, held_out if has_split else _HELD_OUT)


def _from_frames(
    reading: Reading, entries: dict[int, Entry], files: dict[int, Path]
) -> _Parameters:
    report = reading.report
    missing = [entry.name for number, entry in entries.items() if number not in files]
    report.leave_out("images without a .frame file", missing)
    wanted = {number: path for number, path in files.items() if number in entries}
    tracked = read_frame_files(reading, wanted)
    theta = {}
    for number, head in tracked.frames.items():
        with report.frame(entries[number].name):
            _require_same(entries[number], head.camera.world_to_camera)
            theta[number] = head.theta
    return tracked.arrays, tracked.identity, theta


def _require_same(entry: Entry, tracked: Float[np.ndarray, "4 4"]) -> None:
    """Raise UnusableFrameError where the entry's camera is not the tracker's."""
    apart = {
        opengl: np.abs(camera_of(entry.values, opengl).world_to_camera - tracked).max()
        for opengl in (False, True)
    }
    if apart[False] <= _CAMERA_TOLERANCE:
        return
    told = f"cameras of {INDEX_FILE} that differ from their .frame file's"
    if apart[True] <= _CAMERA_TOLERANCE:
        told += ", since their axes are OpenGL's, not OpenCV's as INSTA's are"
    raise UnusableFrameError(told)


def _from_meshes(reading: Reading, entries: dict[int, Entry]) -> _Parameters:
    report, folder = reading.report, reading.folder
    arrays = flame_for(reading, FLAME_VERSION)
    expressions = {}
    meshes = {}
    for number, entry in entries.items():
        with report.frame(entry.name):
            expressions[number] = _expression(folder, entry, arrays)
            mesh = entry.values.get("mesh_path", f"meshes/{number:05d}.obj")
            if not isinstance(mesh, str) or not os.path.isfile(folder.path(mesh)):
                raise UnusableFrameError("frames with neither a .frame file nor a mesh")
            meshes[number] = folder.path(mesh)
    if not meshes:
        raise reading.no_frames()
    report.note(
        f"there are no .frame files: head shape, jaw, eyes and eyelids are fitted to "
        f"{len(meshes)} meshes"
    )
    return arrays, *fit_meshes(reading, arrays, {n: expressions[n] for n in meshes}, meshes)


def _expression(folder: Folder, entry: Entry, arrays: HeadArrays) -> Float[np.ndarray, "_"]:
    name = entry.values.get("exp_path")
    if not isinstance(name, str):
        raise UnusableFrameError("frames without exp_path")
    path = folder.path(name)
    try:
        content = read_file(path, _EXPRESSION_BYTES)
        values = np.array([float(word) for word in content.split()])
    except ValueError:
        raise UnusableFrameError("expressions that cannot be read") from None
    if len(values) != EXPRESSIONS:
        raise UnusableFrameError(f"expressions that are not {EXPRESSIONS} numbers")
    return padded(values, arrays.num_expressions, "expression", arrays.name)
