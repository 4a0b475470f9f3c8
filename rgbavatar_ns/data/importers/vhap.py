"""VHAP's export, as GaussianAvatars reads it: OpenGL cameras, axis-angle FLAME 2023 parameters."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.data.importers.flame_parameters import flame_for, padded
from rgbavatar_ns.data.importers.folder import Folder, finite, numbers, read_npz
from rgbavatar_ns.data.importers.frame_images import FrameImage
from rgbavatar_ns.data.importers.frame_record import FrameRecord
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.source import Reading, Source, assemble
from rgbavatar_ns.data.importers.transforms import (
    Entry,
    camera_of,
    first_frame,
    read_transforms,
    size_of,
)
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.flame import FLAME_VERTICES

FLAME_VERSION = "2023"
TEETH_VERTICES = 120
_OFFSET_TOLERANCE_M = 1e-6
_SHAPE_TOLERANCE = 1e-5
_MAX_INDEX = 10**7


def is_vhap(folder: Folder) -> bool:
    """A transforms.json whose frames name FLAME parameters."""
    return "flame_param_path" in (first_frame(folder) or {})


def read_vhap(reading: Reading) -> Source:
    """VHAP's export of one camera or many; held out is what transforms_val and _test hold.

    Its images lie over white, by the masks beside them. With several cameras a frame's number is
    timestep x cameras + place of the camera.
    """
    entries, has_split = read_transforms(reading)
    frames: list[tuple[Entry, tuple[int, int]]] = []
    for entry in entries:
        with reading.report.frame(entry.name):
            place = (_index(entry.values, "timestep_index"), _index(entry.values, "camera_index"))
            frames.append((entry, place))
    # The first moment tells the subject's shape, whichever file names it.
    frames.sort(key=lambda frame: frame[1])
    cameras = sorted({camera for _, (_, camera) in frames})
    subject = VhapSubject(reading)
    records: list[FrameRecord] = []
    held_out = set()
    for entry, (timestep, camera) in reading.each(frames):
        with reading.report.frame(entry.name):
            number = timestep * len(cameras) + cameras.index(camera)
            several = len(cameras) > 1
            path = entry.values.get("flame_param_path")
            if not isinstance(path, str):
                raise UnusableFrameError("frames without flame_param_path")
            records.append(
                FrameRecord(
                    number,
                    _frame_image(reading.folder, entry),
                    subject.theta(reading.folder.path(path)),
                    camera_of(entry.values, opengl=True),
                    size_of(entry.values),
                    str(entry.values.get("camera_id", camera)) if several else None,
                    timestep if several else None,
                )
            )
            if entry.held_out:
                held_out.add(number)
    hold_out = held_out if has_split else 0
    return assemble(reading, records, subject.arrays, subject.identity, hold_out)


def _index(values: dict[str, Any], name: str) -> int:
    value = values.get(name, 0 if name == "camera_index" else None)
    if type(value) is not int or not 0 <= value < _MAX_INDEX:
        raise UnusableFrameError(f"frames without a valid {name}")
    return value


def _frame_image(folder: Folder, entry: Entry) -> FrameImage:
    mask = entry.values.get("fg_mask_path")
    if mask is None:
        return FrameImage(folder.path(entry.name))
    if not isinstance(mask, str) or not os.path.isfile(folder.path(mask)):
        raise UnusableFrameError("frames whose mask is missing")
    return FrameImage(folder.path(entry.name), alpha=folder.path(mask), over_white=True)


@dataclass(frozen=True)
class _Shape:
    """A subject's identity, and offsets of vertices if there are any."""

    identity: Float[np.ndarray, "_"]
    offset: Float[np.ndarray, "_ 3"] | None

    def is_like(self, other: "_Shape") -> bool:
        """Whether both are one but for rounding."""
        if np.abs(self.identity - other.identity).max() > _SHAPE_TOLERANCE:
            return False
        if self.offset is None or other.offset is None:
            return self.offset is other.offset
        same_size = self.offset.shape == other.offset.shape
        return same_size and bool(np.abs(self.offset - other.offset).max() < _OFFSET_TOLERANCE_M)


@dataclass
class VhapSubject:
    """The head model with the subject's own offsets, made of the first parameters that are read.

    United sequences may each have a shape of their own: all get the first one's, as in
    GaussianAvatars.
    """

    reading: Reading
    identity: Float[np.ndarray, "_"] = field(default_factory=lambda: np.zeros(0))
    """The subject's shape."""
    _arrays: HeadArrays | None = None
    _shapes: dict[Path, "_Shape"] = field(default_factory=dict)
    """Of each folder of parameters."""
    _known: dict[Path, dict[str, Float[np.ndarray, "_"]]] = field(default_factory=dict)

    @property
    def arrays(self) -> HeadArrays:
        """FLAME with the subject's offsets; raises UserError where no frame could be read."""
        if self._arrays is None:
            raise self.reading.no_frames()
        return self._arrays

    def theta(self, path: Path) -> dict[str, Float[np.ndarray, "_"]]:
        """Head parameters of a file, which several cameras may share."""
        if path not in self._known:
            self._known[path] = self.parse(read_npz(path), path.parent)
        return self._known[path]

    def parse(
        self, values: dict[str, np.ndarray], sequence: Path
    ) -> dict[str, Float[np.ndarray, "_"]]:
        """Head parameters of one moment; raises UnusableFrameError where some are missing.

        sequence: the folder that they lie in; within it the shape is one.
        """
        offset = static_offset(values.get("static_offset"))
        if "shape" not in values or "expr" not in values:
            raise UnusableFrameError("parameters without 'shape' or 'expr'")
        eyes = numbers(values.get("eyes_pose"), 6, "eyes_pose")
        theta = {
            "translation": numbers(values.get("translation"), 3, "translation"),
            "rotation": numbers(values.get("rotation"), 3, "rotation"),
            "neck": numbers(values.get("neck_pose"), 3, "neck_pose"),
            "jaw": numbers(values.get("jaw_pose"), 3, "jaw_pose"),
            "left_eye": eyes[:3],
            "right_eye": eyes[3:],
        }
        if self._arrays is None:
            self._arrays = flame_for(self.reading, FLAME_VERSION, offset)
            self.identity = padded(
                values["shape"], self._arrays.num_identity, "shape", self._arrays.name
            )
        arrays = self._arrays
        identity = padded(values["shape"], arrays.num_identity, "shape", arrays.name)
        shape = _Shape(identity, offset)
        if not shape.is_like(self._shapes.setdefault(sequence, shape)):
            raise UnusableFrameError("records of another head shape than the first")
        if not shape.is_like(next(iter(self._shapes.values()))):
            self.reading.report.note(
                "the sequences have head shapes of their own: all get the first one's, as "
                "GaussianAvatars reads them"
            )
        expression = padded(values["expr"], arrays.num_expressions, "expr", arrays.name)
        return {"expression": expression, **theta}


def static_offset(value: np.ndarray | None) -> Float[np.ndarray, "_ 3"] | None:
    """The subject's own offsets of FLAME's vertices, those of VHAP's teeth after them."""
    if value is None:
        return None
    offset = value[0] if value.ndim == 3 and len(value) == 1 else value
    known = (FLAME_VERTICES, FLAME_VERTICES + TEETH_VERTICES)
    if offset.ndim != 2 or offset.shape[1] != 3 or len(offset) not in known:
        raise UnusableFrameError("a static_offset that is not of FLAME's vertices")
    if offset.dtype.kind != "f":
        raise UnusableFrameError("a static_offset that is no numbers")
    return finite(offset, "static_offset")
