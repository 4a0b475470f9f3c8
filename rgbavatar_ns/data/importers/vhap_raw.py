"""VHAP's raw tracker output: one npz of all moments, an uncalibrated camera in front."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from rgbavatar_ns.data.importers.folder import IMPORTED_SUFFIXES, Folder, numbers, read_npz
from rgbavatar_ns.data.importers.frame_images import FrameImage, image_header
from rgbavatar_ns.data.importers.frame_record import CameraRecord, FrameRecord
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.source import Reading, Source, assemble
from rgbavatar_ns.data.importers.vhap import VhapSubject
from rgbavatar_ns.errors import UserError

_FILE = re.compile(r"tracked_flame_params_?(\d*)\.npz")
_MASKS = ("fg_masks", "alpha_maps", "masks", "mask", "alpha")
_SHARED = ("shape", "static_offset")
_PER_FRAME = ("translation", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "expr")
_DISTANCE_M = 1.0
_EXPORT = "Run VHAP's export script and import its output."


def is_vhap_raw(folder: Folder) -> bool:
    """A `tracked_flame_params_EPOCH.npz`."""
    return any(_FILE.fullmatch(path.name) for path in folder.root.glob("tracked_flame_params*.npz"))


def read_vhap_raw(reading: Reading) -> Source:
    """The latest epoch's parameters with the images of the folder, or of the option `images`.

    The camera looks along -z from (0, 0, 1); its focal length is focal_length times the longer
    side. Nothing is held out by the format.
    """
    found = {path: _FILE.fullmatch(path.name) for path in reading.folder.root.glob("*.npz")}
    epochs = {int(match[1] or 0): path for path, match in found.items() if match}
    if not epochs:
        raise UserError(
            f"{reading.folder.root} holds no tracked_flame_params_EPOCH.npz of VHAP's tracker.",
            "Name the folder that holds it, or leave --format out.",
        )
    path = reading.folder.path(epochs[max(epochs)].name)
    values = _values(reading, path)
    names = [str(name) for name in np.atleast_1d(values["timestep_id"]).tolist()]
    if len(set(names)) < len(names):
        raise UserError(f"{path} names a moment twice.", _EXPORT)
    images = _by_stem(reading, reading.options.images, ("images",))
    masks = _by_stem(reading, reading.options.masks, _MASKS)
    reading.report.leave_out(
        "images without a record", [images[stem].name for stem in images if stem not in names]
    )
    subject = VhapSubject(reading)
    records = []
    for moment, name in enumerate(reading.each(names)):
        with reading.report.frame(name):
            if name not in images:
                raise UnusableFrameError("records without an image")
            if masks and name not in masks:
                raise UnusableFrameError("images without a matte")
            own = {key: values[key][moment] for key in _PER_FRAME if key in values}
            own |= {key: values[key] for key in _SHARED if key in values}
            theta = subject.parse(own, path.parent)
            header = image_header(images[name])
            camera = _camera(values, header.width, header.height)
            frame_image = FrameImage(images[name], masks.get(name))
            records.append(FrameRecord(moment, frame_image, theta, camera))
    return assemble(reading, records, subject.arrays, subject.identity, 0)


def _values(reading: Reading, path: Path) -> dict[str, np.ndarray]:
    try:
        values = read_npz(path)
    except UnusableFrameError as error:
        raise UserError(f"{path} holds {error}.", _EXPORT) from None
    missing = [name for name in (*_PER_FRAME, "shape", "timestep_id") if name not in values]
    if missing:
        raise UserError(f"{path} lacks {', '.join(missing)}.", _EXPORT)
    if "focal_length" not in values:
        raise UserError(
            f"{reading} is of calibrated cameras, which this file does not hold.", _EXPORT
        )
    moments = len(np.atleast_1d(values["timestep_id"]))
    for name in _PER_FRAME:
        if values[name].ndim < 2 or len(values[name]) != moments:
            raise UserError(
                f"{path} has {name} of shape {values[name].shape} for {moments} moments.", _EXPORT
            )
    return values


def _by_stem(reading: Reading, given: Path | None, usual: tuple[str, ...]) -> dict[str, Path]:
    """Pictures by name without suffix, from the folder given or the first usual one there is."""
    if given is not None:
        place = reading.folder.given(given)
    else:
        there = [name for name in usual if (reading.folder.root / name).is_dir()]
        if not there:
            return {}
        place = Folder(reading.folder.path(there[0]), reading.folder.allow_outside)
    return {
        path.stem: place.path(path.name)
        for path in sorted(place.root.iterdir())
        if path.suffix.lower() in IMPORTED_SUFFIXES and not path.name.startswith(".")
    }


def _camera(values: dict[str, Any], width: int, height: int) -> CameraRecord:
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    world_to_camera[2, 3] = _DISTANCE_M
    focal = numbers(values["focal_length"], 1, "focal_length")[0] * max(width, height)
    centre = np.array([width / 2, height / 2])
    return CameraRecord(world_to_camera, np.array([focal, focal]), centre)
