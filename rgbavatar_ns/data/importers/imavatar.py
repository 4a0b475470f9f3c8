"""IMAvatar's flame_params.json, which SplattingAvatar, PointAvatar and MonoGaussianAvatar share."""

import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.data.importers.flame_parameters import flame_for, padded
from rgbavatar_ns.data.importers.folder import (
    IMPORTED_SUFFIXES,
    Folder,
    matrix,
    number_of,
    numbers,
    read_json,
)
from rgbavatar_ns.data.importers.frame_images import FrameImage, image_header
from rgbavatar_ns.data.importers.frame_record import CameraRecord, FrameRecord
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.source import Reading, Source, assemble
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.joints import JOINT_FIELDS

INDEX_FILE = "flame_params.json"
FLAME_VERSION = "2020"
SCALE = 4.0
"""IMAvatar's world is FLAME's times this."""
OLDER_SIDE_PX = 512
"""Of the images whose pixels the older `intrinsics` count."""
_HELD_OUT = 350
_PRINCIPAL_POINTS = (-0.5, 1.5)
"""In sides of the image: one of a cut-out picture may lie outside of it, but not far."""
_IMAGES = ("image", "images")


def is_imavatar(folder: Folder) -> bool:
    """A `flame_params.json`."""
    return folder.has(INDEX_FILE)


def read_imavatar(reading: Reading) -> Source:
    """Metres instead of quarters of them, OpenCV instead of OpenGL cameras.

    Mattes are in `mask`, where there is one. The last 350 frames are held out.
    """
    path = reading.folder.path(INDEX_FILE)
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path} has no list of frames.", "Export the data again.")
    arrays = flame_for(reading, FLAME_VERSION)
    try:
        identity = padded(content.get("shape_params"), arrays.num_identity, "shape", arrays.name)
        intrinsics = _fractions(numbers(content.get("intrinsics"), 4, "intrinsics"))
    except UnusableFrameError as error:
        raise UserError(f"{path} has {error}.", "Export the data again.") from None
    low, high = _PRINCIPAL_POINTS
    if not ((low <= intrinsics[2:]) & (intrinsics[2:] <= high)).all():
        x, y = intrinsics[2:]
        raise UserError(
            f"{path} has a principal point at {x:g}, {y:g} of the image's width and height.",
            "Give the intrinsics as fractions of the image's size, or all as pixels of a picture "
            f"of {OLDER_SIDE_PX}.",
        )
    masks = "mask" if reading.folder.has("mask") else None
    records, named, lengths = [], set(), set()
    for place, frame in enumerate(reading.each(frames)):
        name = str(frame.get("file_path")) if isinstance(frame, dict) else f"frame {place}"
        with reading.report.frame(name):
            if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
                raise UnusableFrameError("frames without file_path")
            image = _image(reading.folder, name)
            named.add(image.name)
            if isinstance(frame.get("expression"), list):
                lengths.add(len(frame["expression"]))
            records.append(_record(reading.folder, frame, image, masks, intrinsics, arrays))
    for folder in _IMAGES:
        files = reading.folder.names(folder, IMPORTED_SUFFIXES)
        left = [image for image in files if image not in named]
        reading.report.leave_out("images without a record", left)
    if len(lengths) > 1:
        raise UserError(
            f"{reading} has expressions of {', '.join(map(str, sorted(lengths)))} numbers.",
            "All frames need the same coefficients: export the data again.",
        )
    return assemble(reading, records, arrays, identity, _HELD_OUT)


def _fractions(intrinsics: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """fx, fy, cx, cy in sides of the image, told from the older form in pixels.

    As IMAvatar's own loader tells them: in pixels the fourth number is above 1.
    """
    return intrinsics / OLDER_SIDE_PX if intrinsics[3] > 1 else intrinsics


def _record(
    folder: Folder,
    frame: dict[str, Any],
    image: Path,
    masks: str | None,
    intrinsics: Float[np.ndarray, "4"],
    arrays: HeadArrays,
) -> FrameRecord:
    number = number_of(image.name)
    if number is None:
        raise UnusableFrameError("images without a number")
    header = image_header(image)
    world_to_camera = np.eye(4)
    world_to_camera[:3] = matrix(_three_rows(frame.get("world_mat")), 3, 4, "world_mat")
    # OpenGL looks along -z with y up, and the world is scaled.
    world_to_camera[1:3] *= -1
    world_to_camera[:3, 3] /= SCALE
    size = np.array([header.width, header.height])
    # Some exporters write the first focal length with the wrong sign.
    camera = CameraRecord(world_to_camera, np.abs(intrinsics[:2]) * size, intrinsics[2:] * size)
    pose = numbers(frame.get("pose"), 15, "pose").reshape(5, 3)
    theta: dict[str, np.ndarray] = dict(zip(JOINT_FIELDS, pose))
    expression = frame.get("expression")
    theta["expression"] = padded(expression, arrays.num_expressions, "expression", arrays.name)
    return FrameRecord(number, _frame_image(folder, image, masks), theta, camera)


def _three_rows(world_mat: Any) -> Any:
    """Some write the last row 0 0 0 1 too."""
    four = isinstance(world_mat, list) and len(world_mat) == 4
    return world_mat[:3] if four and world_mat[3] == [0, 0, 0, 1] else world_mat


def _image(folder: Folder, file_path: str) -> Path:
    """The file that a path without suffix means; the folder is called image or images."""
    named = PurePosixPath(file_path)
    parents = [named.parent, *(named.parent.parent / name for name in _IMAGES)]
    for parent in parents:
        for suffix in ("", *IMPORTED_SUFFIXES):
            candidate = folder.path(f"{parent / named.name}{suffix}")
            if os.path.isfile(candidate):
                return candidate
    raise UnusableFrameError("records without an image")


def _frame_image(folder: Folder, image: Path, masks: str | None) -> FrameImage:
    if masks is None:
        return FrameImage(image)
    for suffix in IMPORTED_SUFFIXES:
        candidate = folder.path(f"{masks}/{image.stem}{suffix}")
        if os.path.isfile(candidate):
            return FrameImage(image, alpha=candidate)
    raise UnusableFrameError("images without a matte")
