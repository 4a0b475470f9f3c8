"""metrical-tracker's `.frame` files, which five systems share."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.data.importers.flame_parameters import (
    flame_for,
    from_6d_rows,
    padded,
    require_rotations,
)
from rgbavatar_ns.data.importers.folder import matrix, numbers
from rgbavatar_ns.data.importers.frame_record import CameraRecord
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.source import Reading
from rgbavatar_ns.data.importers.torch_file import read_torch_file
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays

FLAME_VERSION = "2020"
_SHAPE_TOLERANCE = _SKEW_TOLERANCE = 1e-3
_MOST_BYTES = 1 << 26
"""A tracker's frame has 20 kB."""
_TURNS = ("jaw", "left_eye", "right_eye")


@dataclass(frozen=True)
class TrackedHead:
    """One `.frame` file: the head stands still, the camera moves about it; `shape`: identity."""

    shape: Float[np.ndarray, "_"]
    theta: dict[str, Float[np.ndarray, "_"]]
    camera: CameraRecord
    size: tuple[int, int] | None


@dataclass(frozen=True)
class TrackedHeads:
    """All `.frame` files of a folder by number, and the head model that they move."""

    arrays: HeadArrays
    identity: Float[np.ndarray, "_"]
    frames: dict[int, TrackedHead]
    unreadable: frozenset[int]


def read_frame_files(reading: Reading, files: dict[int, Path]) -> TrackedHeads:
    """Read all `.frame` files, broken ones into the report; raises UserError where all are."""
    arrays = flame_for(reading, FLAME_VERSION)
    if arrays.eyelid_dirs is None:
        reading.report.note(
            "the FLAME model has no eyelid offsets (l_eyelid.npy, r_eyelid.npy): the tracked "
            "eyelids are left out"
        )
    frames: dict[int, TrackedHead] = {}
    for number in reading.each(files):
        with reading.report.frame(files[number].name):
            frames[number] = parse_frame(_read(files[number]), arrays)
    unreadable = frozenset(files.keys() - frames.keys())
    if not frames:
        reading.report.settle(str(reading), False)
        raise UserError(f"{reading} has no .frame files.", "Name the tracker's output folder.")
    identity = next(iter(frames.values())).shape
    other = [n for n, f in frames.items() if np.abs(f.shape - identity).max() > _SHAPE_TOLERANCE]
    reading.report.leave_out(
        "records of another head shape than the first", [files[number].name for number in other]
    )
    for number in other:
        del frames[number]
    return TrackedHeads(arrays, identity, _turned(frames), unreadable | frozenset(other))


def _turned(frames: dict[int, TrackedHead]) -> dict[int, TrackedHead]:
    """The frames with their turns as axis-angle; all at once, since one takes as long as many."""
    if not frames:
        return {}
    rows = np.stack([[frame.theta[name] for name in _TURNS] for frame in frames.values()])
    return {
        number: replace(frame, theta={**frame.theta, **dict(zip(_TURNS, turns))})
        for (number, frame), turns in zip(frames.items(), from_6d_rows(rows))
    }


def _read(path: Path) -> Any:
    try:
        return read_torch_file(path, _MOST_BYTES)
    except UserError as error:
        # Without the file's name, so that equal faults are counted together.
        cause = error.cause.replace(str(path), "the file").rstrip(".")
        raise UnusableFrameError(f"records that cannot be read ({cause})") from None


def parse_frame(content: Any, arrays: HeadArrays) -> TrackedHead:
    """One file's dict, its turns as the first two rows of matrices; UnusableFrameError if unfit."""
    if not isinstance(content, dict):
        raise UnusableFrameError("records that are no dict")
    flame, opencv = content.get("flame"), content.get("opencv")
    if not isinstance(flame, dict) or not isinstance(opencv, dict):
        raise UnusableFrameError("records without 'flame' and 'opencv'")
    eyes = numbers(flame.get("eyes"), 12, "eyes").reshape(2, 6)
    turns = np.stack([numbers(flame.get("jaw"), 6, "jaw"), *eyes])
    require_rotations(turns, "jaw or eyes")
    expression, shape = flame.get("exp"), flame.get("shape")
    if expression is None or shape is None:
        raise UnusableFrameError("records without 'exp' or 'shape'")
    theta = {
        "expression": padded(expression, arrays.num_expressions, "exp", arrays.name),
        **dict(zip(_TURNS, turns)),
    }
    if arrays.eyelid_dirs is not None and "eyelids" in flame:
        theta["eyelids"] = numbers(flame["eyelids"], 2, "eyelids")
    shape = padded(shape, arrays.num_identity, "shape", arrays.name)
    camera, size = _camera(opencv), None
    if content.get("img_size") is not None:
        height, width = numbers(content["img_size"], 2, "img_size")
        size = int(width), int(height)
    return TrackedHead(shape, theta, camera, size)


def _camera(opencv: dict[str, Any]) -> CameraRecord:
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = matrix(opencv.get("R"), 3, 3, "R")
    world_to_camera[:3, 3] = numbers(opencv.get("t"), 3, "t")
    intrinsics = matrix(opencv.get("K"), 3, 3, "K")
    last_row = np.abs(intrinsics[2] - [0, 0, 1]).max()
    if max(abs(intrinsics[0, 1]), abs(intrinsics[1, 0]), last_row) > _SKEW_TOLERANCE:
        raise UnusableFrameError("cameras whose K is no pinhole in pixels")
    return CameraRecord(world_to_camera, np.diag(intrinsics)[:2].copy(), intrinsics[:2, 2].copy())
