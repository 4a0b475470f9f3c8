"""The source that a format's records make up, checked and in one form."""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.data.importers.folder import Folder
from rgbavatar_ns.data.importers.frame_images import FrameImage, ImageHeader, image_header
from rgbavatar_ns.data.importers.frame_record import FrameRecord
from rgbavatar_ns.data.importers.head_pose import all_is_the_cameras, place_head_pose
from rgbavatar_ns.data.importers.import_report import ImportReport, UnusableFrameError
from rgbavatar_ns.data.importers.options import HeadPose, ImportOptions, Progress
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, HeadModel, ThetaLayout
from rgbavatar_ns.kernels.types import PinholeCameras

_LARGEST_SIZE = 16384
T = TypeVar("T")


@dataclass
class Reading:
    """A folder being read: where, with which options, who watches, and what was found odd."""

    format: str
    folder: Folder
    options: ImportOptions
    progress: Progress | None = None
    report: ImportReport = field(default_factory=ImportReport)

    def each(self, items: Collection[T], stage: str = "reading frames") -> Iterator[T]:
        """The items one by one, each told to `progress` when it is done."""
        for done, item in enumerate(items, 1):
            yield item
            if self.progress is not None:
                self.progress(stage, done, len(items))

    def no_frames(self) -> UserError:
        """What to raise where no frame is left; raises about those left out if there are any."""
        self.report.settle(str(self), False)
        return UserError(f"{self} has no frames.", "Name the folder that holds the data.")

    def __str__(self) -> str:
        return f"The {self.format} data in {self.folder.root}"


@dataclass(frozen=True)
class Source:
    """A format's frames in order of their numbers, checked as far as pixels are not needed."""

    format: str
    root: Path
    arrays: HeadArrays
    layout: ThetaLayout
    identity: Float[Tensor, "I"]
    index: tuple[int, ...]
    frame_images: tuple[FrameImage, ...]
    theta: Float[Tensor, "F H"]
    cameras: PinholeCameras
    test: frozenset[int]
    camera_names: tuple[str | None, ...]
    timesteps: tuple[int | None, ...]
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.index)


def assemble(
    reading: Reading,
    records: Sequence[FrameRecord],
    arrays: HeadArrays,
    identity: Float[np.ndarray, "_"],
    hold_out: int | Set[int],
) -> Source:
    """Check records together and bring them into one form; raises UserError about what is odd.

    hold_out: how many of the last frames the format holds out, or the numbers of those.
    """
    layout = HeadModel(arrays).layout
    records = _unique(reading, sorted(records, key=lambda record: record.index))
    size, records = _one_size(reading, _possible(reading, records, layout))
    reading.report.settle(str(reading), reading.options.allow_partial)
    if not records:
        raise UserError(f"{reading} has no frame that can be used.", "Look at its files.")
    records = place_head_pose(records, arrays, identity, _head_pose(reading, records))
    theta = _theta(records, layout)
    if absurd := layout.absurd(theta):
        raise UserError(f"{reading} moves a head as no person can: {absurd}.", "Look at its files.")
    width, height = size
    cameras = PinholeCameras(
        _stack([record.camera.world_to_camera for record in records]),
        _stack([record.camera.focal_px for record in records]),
        _stack([record.camera.principal_point_px for record in records]),
        width,
        height,
    )
    return Source(
        format=reading.format,
        root=reading.folder.root,
        arrays=arrays,
        layout=layout,
        identity=torch.from_numpy(identity).float(),
        index=tuple(record.index for record in records),
        frame_images=tuple(record.frame_image for record in records),
        theta=theta.float(),
        cameras=cameras,
        test=_held_out(reading, records, hold_out),
        camera_names=tuple(record.camera_name for record in records),
        timesteps=tuple(record.timestep for record in records),
        notes=tuple(reading.report.notes),
    )


def _theta(records: Sequence[FrameRecord], layout: ThetaLayout) -> Float[Tensor, "F H"]:
    columns = {
        field.name: np.stack([r.theta.get(field.name, np.zeros(field.size)) for r in records])
        for field in layout.fields
    }
    return layout.join({name: torch.from_numpy(column) for name, column in columns.items()})


def _possible(
    reading: Reading, records: list[FrameRecord], layout: ThetaLayout
) -> list[FrameRecord]:
    """The records of what a person can do; the others go into the report."""
    if not records or layout.absurd(_theta(records, layout)) is None:
        return records
    kept = []
    for record in records:
        with reading.report.frame(record.frame_image.color.name):
            if absurd := layout.absurd(_theta([record], layout)[0]):
                raise UnusableFrameError(f"records of what no person can do ({absurd})")
            kept.append(record)
    return kept


def _head_pose(reading: Reading, records: Sequence[FrameRecord]) -> HeadPose:
    chosen = reading.options.head_pose
    if chosen != "auto":
        return chosen
    if not all_is_the_cameras(records):
        return "source"
    reading.report.note(
        "the format moves the camera about a still head; here the head moves before a still camera"
    )
    return "head"


def _stack(values: Sequence[np.ndarray]) -> Float[Tensor, "F *shape"]:
    return torch.from_numpy(np.stack(values)).float()


def _unique(reading: Reading, records: list[FrameRecord]) -> list[FrameRecord]:
    counts = Counter(record.index for record in records)
    twice = [str(number) for number, count in counts.items() if count > 1]
    reading.report.leave_out("frame numbers that occur more than once", twice)
    return [record for record in records if counts[record.index] == 1]


def _one_size(
    reading: Reading, records: list[FrameRecord]
) -> tuple[tuple[int, int], list[FrameRecord]]:
    """The size that most images have, and the records of that size that camera and image share."""
    headers: dict[int, ImageHeader] = {}
    for record in records:
        with reading.report.frame(record.frame_image.color.name):
            headers[record.index] = image_header(record.frame_image.color)
    if not headers:
        raise reading.no_frames()
    sizes = Counter((header.width, header.height) for header in headers.values())
    size = sizes.most_common(1)[0][0]
    if max(size) > _LARGEST_SIZE:
        raise UserError(f"{reading} has images of {size[0]} x {size[1]}.", "Make them smaller.")
    kept = []
    for record in records:
        if record.index in headers:
            with reading.report.frame(record.frame_image.color.name):
                _check_header(record, headers[record.index], size, reading.options.allow_opaque)
                kept.append(record)
    return size, kept


def _check_header(
    record: FrameRecord, header: ImageHeader, size: tuple[int, int], allow_opaque: bool
) -> None:
    found = f"{header.width} x {header.height}"
    if (header.width, header.height) != size:
        raise UnusableFrameError(f"images of {found} pixels among ones of {size[0]} x {size[1]}")
    if record.size is not None and record.size != size:
        raise UnusableFrameError(
            f"cameras for images of {record.size[0]} x {record.size[1]} pixels, where the images "
            f"have {found}"
        )
    if record.frame_image.alpha is None and not header.has_alpha and not allow_opaque:
        raise UnusableFrameError(
            "images without a matte (--allow-opaque takes them with their background)"
        )


def _held_out(
    reading: Reading, records: Sequence[FrameRecord], by_format: int | Set[int]
) -> frozenset[int]:
    """Numbers of the frames to hold out, after the options and the format's own rule."""
    options, numbers = reading.options, [record.index for record in records]
    if options.test_cameras:
        return _of_cameras(reading, records)
    last = options.test_frames
    if last is not None:
        if last >= len(numbers):
            raise UserError(
                f"{reading} has {len(numbers)} frames, of which {last} cannot be held out.",
                "Name a smaller --test-frames.",
            )
    elif not isinstance(by_format, int):
        held_out = frozenset(by_format & set(numbers))
        if len(held_out) == len(numbers):
            raise UserError(
                f"{reading} holds out all of its frames.", "Name another count by --test-frames."
            )
        return held_out
    else:
        last = by_format
        if last >= len(numbers):
            last = len(numbers) // 4
            reading.report.note(
                f"the format holds out the last {by_format} frames, but there are only "
                f"{len(numbers)}: the last {last} are held out"
            )
    return frozenset(numbers[len(numbers) - last :])


def _of_cameras(reading: Reading, records: Sequence[FrameRecord]) -> frozenset[int]:
    wanted = set(reading.options.test_cameras)
    known = {record.camera_name for record in records if record.camera_name is not None}
    if not wanted <= known or wanted == known:
        names = ", ".join(sorted(known)) or "one without a name"
        raise UserError(
            f"{reading} has the cameras {names}; {', '.join(sorted(wanted))} cannot be held out.",
            "Name some of its cameras, but not all.",
        )
    return frozenset(record.index for record in records if record.camera_name in wanted)
