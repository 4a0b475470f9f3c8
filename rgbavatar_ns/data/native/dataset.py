"""A folder of tracked frames, read and checked: every fault is one error with its remedy."""

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, TypeGuard

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.data.native.format import (
    FORMAT,
    HEAD_FILE,
    INDEX_FILE,
    THETA_FILE,
    VERSIONS,
    cameras_from_json,
)
from rgbavatar_ns.data.png import MAX_PIXELS, png_size, read_png_rgba
from rgbavatar_ns.drawing.compositing import all_filmed
from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.head import HeadArrays, HeadModel, ThetaLayout
from rgbavatar_ns.kernels.types import PinholeCameras
from rgbavatar_ns.options import FRAME_RATES
from rgbavatar_ns.reading import DamagedFileError, json_numbers, load_array, load_json

_MAKE_ONE = (
    "Make a dataset with `rgbavatar demo-data FOLDER` or `rgbavatar track VIDEO FOLDER` and pass "
    "that folder, or pass another system's output as docs/dataset_format.md lists them."
)
_WRITE_AGAIN = "Write the dataset again, or mend this file."
_LARGEST_NUMBER = 10**15
USUAL_FRAMES_PER_SECOND = 25.0
"""Of a film whose rate is not known: the paper's."""
_SHOWN = 200


@dataclass(frozen=True)
class TrackedDataset:
    """Tracked frames of one person; images stay on disk until they are asked for.

    A "position" counts frames in the order of this dataset from 0; `frame_index` says which frame
    of the source that is. `train` and `test` partition the positions.
    """

    root: Path
    arrays: HeadArrays
    identity: Float[Tensor, "I"]
    layout: ThetaLayout
    theta: Float[Tensor, "F H"]
    cameras: PinholeCameras
    """One for each frame (C = F), also where all are the same."""
    image_paths: list[Path]
    frame_index: tuple[int, ...]
    width: int
    height: int
    test: tuple[int, ...]
    """Positions of the held-out frames: the last ones as in the paper, or those of held-out
    cameras and moments, as the source has it."""
    camera_names: tuple[str, ...] = ()
    """Which of several cameras saw each frame; empty where there is one camera."""
    timesteps: tuple[int, ...] = ()
    """The moment of each frame, the same for all cameras; empty where each frame has its own."""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Where an imported dataset came from: `format`, `path`, `notes`."""
    marks_unfilmed: bool = False
    """Whether `UNFILMED_RGBA` says something in its files; else it is background by chance."""
    frames_per_second: float | None = None
    """The film's rate; None where nobody said it."""

    def __len__(self) -> int:
        return len(self.image_paths)

    @property
    def train(self) -> tuple[int, ...]:
        """Positions of the frames to train from."""
        held_out = set(self.test)
        return tuple(position for position in range(len(self)) if position not in held_out)

    @property
    def playback_rate(self) -> float:
        """Frames per second to show it at: the film's own, or 25 where it is not known."""
        return self.frames_per_second or USUAL_FRAMES_PER_SECOND

    def of_one_camera(self, positions: Iterable[int]) -> tuple[int, ...]:
        """Those of the positions that the first one's camera saw: the others saw the same."""
        listed, names = tuple(positions), self.camera_names
        return tuple(p for p in listed if not names or names[p] == names[listed[0]])

    @property
    def moments(self) -> tuple[int, ...]:
        """When each frame was filmed, in frames of the film: what is not tracked leaves a gap.

        Without timesteps one camera's numbers say it; of several, where numbers count all, the
        place among the camera's own frames.
        """
        if self.timesteps or len(set(self.camera_names)) < 2:
            return self.timesteps or self.frame_index
        moments, counts = [0] * len(self), Counter[str]()
        for position in sorted(range(len(self)), key=self.frame_index.__getitem__):
            name = self.camera_names[position]
            moments[position] = counts[name]
            counts[name] += 1
        return tuple(moments)

    @property
    def films(self) -> tuple[tuple[int, ...], ...]:
        """Each camera's positions as they follow one another in time; the first frame's first."""
        names, moments = self.camera_names or ("",) * len(self), self.moments
        films: dict[str, list[int]] = {name: [] for name in names}
        for position in sorted(range(len(self)), key=moments.__getitem__):
            films[names[position]].append(position)
        return tuple(map(tuple, films.values()))

    def read_image(self, position: int) -> UInt8[np.ndarray, "height width 4"]:
        """Decode one frame to RGBA, straight alpha, `UNFILMED_RGBA` where nobody filmed.

        Raises UserError if it is missing, damaged or odd.
        """
        path = self.image_paths[position]
        try:
            image = read_png_rgba(path)
        except UserError as error:
            origin = self.source.get("path")
            if origin is None:
                raise
            remedy = f"Delete the folder {self.root}, so that it is imported anew from {origin}."
            raise UserError(error.cause, remedy) from None
        height, width = image.shape[:2]
        _check_size(path, (width, height), (self.width, self.height))
        return image if self.marks_unfilmed else all_filmed(image)


def load_native(path: str | Path) -> TrackedDataset:
    """Read a folder in the project's own format, pixels when decoded; UserError about any fault."""
    root = Path(path)
    index = _read_index(root)
    width, height = _whole(index, "width"), _whole(index, "height")
    arrays = _read_head(root, str(index.get("head")))
    layout = _read_layout(root, index, arrays)
    identity = _read_identity(root, index, arrays)
    frames = _read_frames(root, index)
    numbers = tuple(frame["index"] for frame in frames)
    theta = _read_theta(root, layout, numbers)
    cameras = cameras_from_json(_camera_records(root, index, frames), width, height)
    image_paths = [root / frame["image"] for frame in frames]
    for image_path in image_paths:
        _check_size(image_path, png_size(image_path), (width, height))
    source = index.get("source", {})
    return TrackedDataset(
        root,
        arrays,
        identity,
        layout,
        theta,
        cameras,
        image_paths,
        numbers,
        width,
        height,
        _read_test(root, index, numbers),
        _column(root, frames, "camera_name", str),
        _column(root, frames, "timestep", int),
        source if isinstance(source, dict) else {},
        index["version"] >= 3 and index.get("unfilmed") is True,
        _read_rate(root, index),
    )


def _read_index(root: Path) -> dict[str, Any]:
    if not os.path.exists(root):
        raise UserError(f"The dataset folder {root} does not exist.", _MAKE_ONE)
    if not root.is_dir():
        raise UserError(f"{root} is a file, not a dataset folder.", _MAKE_ONE)
    path = root / INDEX_FILE
    if not path.exists():
        what = "is empty" if not any(root.iterdir()) else f"has no {INDEX_FILE}"
        raise UserError(f"The dataset folder {root} {what}.", _MAKE_ONE)
    try:
        index = load_json(path)
    except DamagedFileError as error:
        raise UserError(f"{path} cannot be read: {error}.", _WRITE_AGAIN) from None
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise UserError(f'{path} does not say "format": "{FORMAT}".', _MAKE_ONE)
    if not _is_whole(index.get("version")) or index["version"] not in VERSIONS:
        raise UserError(
            f"{path} has version {index.get('version')} of the format; versions "
            f"{', '.join(map(str, VERSIONS))} are known.",
            "Update rgbavatar-ns, or write the dataset again with this version of it.",
        )
    missing = [name for name in ("head", "identity", "layout", "frames") if name not in index]
    if missing:
        raise UserError(f"{path} lacks {', '.join(missing)}.", _WRITE_AGAIN)
    return index


def _whole(index: dict[str, Any], name: str) -> int:
    value = index.get(name)
    if not _is_whole(value) or not 1 <= value <= MAX_PIXELS:
        raise UserError(
            f"{INDEX_FILE} has {name} = {str(value)[:_SHOWN]}; a positive whole number is needed.",
            _WRITE_AGAIN,
        )
    return value


def _read_rate(root: Path, index: dict[str, Any]) -> float | None:
    """The film's rate; None where the index has none."""
    if "frames_per_second" not in index:
        return None
    rate = index["frames_per_second"]
    if type(rate) not in (int, float) or not FRAME_RATES.holds(rate):
        raise UserError(
            f"{root / INDEX_FILE} has frames_per_second = {str(rate)[:_SHOWN]}; a number "
            f"{FRAME_RATES} is needed.",
            "Mend it, or leave it out: the film is then shown at 25.",
        )
    return float(rate)


def _is_whole(value: Any) -> TypeGuard[int]:
    """A whole number within reason, and not true or false, which Python takes for 1 and 0."""
    return type(value) is int and 0 <= value <= _LARGEST_NUMBER


def _read_head(root: Path, name: str) -> HeadArrays:
    path = root / HEAD_FILE
    if os.path.lexists(path):
        return HeadArrays.load(path)
    embedded = HeadArrays.embedded_as(name)
    if embedded is None:
        raise UserError(
            f"The dataset {root} was made for the head '{name[:_SHOWN]}', which is not known here.",
            f"Put its arrays beside it as {HEAD_FILE}, or track the video with the embedded head.",
        )
    return embedded


def _read_layout(root: Path, index: dict[str, Any], arrays: HeadArrays) -> ThetaLayout:
    layout = ThetaLayout.from_json(index["layout"])
    expected = HeadModel(arrays).layout
    if layout != expected:
        raise UserError(
            f"The dataset {root} has theta of {layout.size} values ({layout}), but the head "
            f"'{arrays.name}' takes {expected.size} ({expected}).",
            "Track the video again with this head.",
        )
    return layout


def _read_identity(root: Path, index: dict[str, Any], arrays: HeadArrays) -> Float[Tensor, "I"]:
    try:
        return torch.from_numpy(json_numbers(index["identity"], (arrays.num_identity,))).float()
    except DamagedFileError:
        raise UserError(
            f"The identity in {root / INDEX_FILE} is not a list of {arrays.num_identity} finite "
            f"numbers, which the head '{arrays.name}' takes.",
            _WRITE_AGAIN,
        ) from None


def _read_frames(root: Path, index: dict[str, Any]) -> list[dict[str, Any]]:
    frames = index["frames"]
    if not isinstance(frames, list) or not frames:
        raise UserError(f"The dataset {root} lists no frames.", _MAKE_ONE)
    for frame in frames:
        whole = isinstance(frame, dict) and _is_whole(frame.get("index"))
        if not whole or not isinstance(frame.get("image"), str):
            raise UserError(
                f"{root / INDEX_FILE} has a frame without a number or an image: "
                f"{str(frame)[:_SHOWN]}.",
                _WRITE_AGAIN,
            )
        relative = PurePosixPath(frame["image"])
        if relative.is_absolute() or ".." in relative.parts:
            raise UserError(
                f"{root / INDEX_FILE} names the image {relative}, which is not in its folder.",
                _WRITE_AGAIN,
            )
    counts = Counter(frame["index"] for frame in frames)
    twice = [number for number, count in counts.items() if count > 1]
    if twice:
        raise UserError(
            f"The dataset {root} has {len(twice)} frame numbers more than once "
            f"({first_few(twice)}).",
            "Give every frame a number of its own.",
        )
    return frames


def _read_theta(root: Path, layout: ThetaLayout, numbers: tuple[int, ...]) -> Float[Tensor, "F H"]:
    path = root / THETA_FILE
    try:
        theta = load_array(path)
    except DamagedFileError as error:
        raise UserError(f"{path} cannot be read: {error}.", _WRITE_AGAIN) from None
    expected = (len(numbers), layout.size)
    if theta.shape != expected or theta.dtype.kind != "f":
        raise UserError(
            f"{path} holds {theta.dtype} of shape {theta.shape}; {len(numbers)} frames of "
            f"{layout.size} values ({layout}) need floats of shape {expected}.",
            "Write the dataset again with the layout of its head.",
        )
    wrong = [number for number, row in zip(numbers, theta) if not np.isfinite(row).all()]
    if wrong:
        raise UserError(
            f"{path} holds NaN or infinite values in {len(wrong)} of {len(numbers)} frames "
            f"({first_few(wrong)}).",
            "Track these frames again, or leave them out of the dataset.",
        )
    read = torch.from_numpy(theta.astype(np.float32))
    for number, row in zip(numbers, read) if layout.absurd(read) else ():
        if absurd := layout.absurd(row):
            raise UserError(
                f"{path} holds what no person can do in frame {number}: {absurd}.",
                "Track this frame again, or leave it out of the dataset.",
            )
    return read


def _camera_records(
    root: Path, index: dict[str, Any], frames: list[dict[str, Any]]
) -> list[tuple[str, Any]]:
    """Each frame's label and camera: its own, one of a name, or the one for all."""
    shared, named = index.get("camera"), index.get("cameras", {})
    records = []
    for frame in frames:
        camera = frame.get("camera", shared)
        if isinstance(camera, str):
            if not isinstance(named, dict) or camera not in named:
                raise UserError(
                    f"{root / INDEX_FILE} names the camera '{camera[:_SHOWN]}' in frame "
                    f"{frame['index']}, but does not describe it.",
                    _WRITE_AGAIN,
                )
            camera = named[camera]
        records.append((f"frame {frame['index']}", camera))
    return records


def _read_test(root: Path, index: dict[str, Any], numbers: tuple[int, ...]) -> tuple[int, ...]:
    """Positions of held-out frames: `test` names them, `test_frames` counts them from the end."""
    if "test" not in index:
        num_frames, count = len(numbers), index.get("test_frames")
        if not _is_whole(count) or not count < num_frames:
            raise UserError(
                f"The dataset {root} holds out {str(count)[:_SHOWN]} of {num_frames} frames.",
                f"Set test_frames in {INDEX_FILE} to a number from 0 to {num_frames - 1}.",
            )
        return tuple(range(num_frames - count, num_frames))
    listed = index["test"]
    if not isinstance(listed, list) or not {type(number) for number in listed} <= {int}:
        raise UserError(
            f"{root / INDEX_FILE} has a `test` that is no list of frame numbers.", _WRITE_AGAIN
        )
    held_out = set(listed)
    unknown = sorted(held_out - set(numbers))
    if unknown or len(held_out) >= len(numbers):
        what = f"{len(unknown)} that are not there ({first_few(unknown)})" if unknown else "all"
        raise UserError(
            f"The dataset {root} holds out {what} of its {len(numbers)} frames.",
            f"Mend the list `test` in {INDEX_FILE}: numbers of frames, but not of all.",
        )
    return tuple(place for place, number in enumerate(numbers) if number in held_out)


def _column(root: Path, frames: list[dict[str, Any]], name: str, kind: type) -> tuple[Any, ...]:
    """An optional entry of all frames, or nothing where none has it."""
    values = tuple(frame.get(name) for frame in frames)
    if all(value is None for value in values):
        return ()
    if not all(_is_whole(value) if kind is int else type(value) is kind for value in values):
        raise UserError(
            f"{root / INDEX_FILE} has a {name} for some frames only, or one that is no "
            f"{kind.__name__}.",
            _WRITE_AGAIN,
        )
    return values


def _check_size(path: Path, size: tuple[int, int], expected: tuple[int, int]) -> None:
    if size != expected:
        raise UserError(
            f"The image {path} is {size[0]} x {size[1]}, but the dataset's images are "
            f"{expected[0]} x {expected[1]} pixels.",
            "Bring all images to one size, or leave this frame out.",
        )
