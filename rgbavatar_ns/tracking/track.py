"""A video in, a tracked dataset out: landmarks, fit, matte, pictures, report."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from rgbavatar_ns.data import DatasetWriter, TrackedDataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.clip import ClipLandmarks, find_landmarks
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.crop import steady_crop
from rgbavatar_ns.tracking.overlay import write_contact_sheet
from rgbavatar_ns.tracking.pictures import TrackedPictures
from rgbavatar_ns.tracking.report import fit_quality, write_report
from rgbavatar_ns.tracking.subject import SubjectTracker
from rgbavatar_ns.tracking.video import FrameSource

Progress = Callable[[int, int], None]
"""Called with (units of work done, units in all); a frame counts four units."""


def track_video(
    videos: Path | str | Sequence[Path | str],
    dst: Path | str,
    config: TrackConfig | None = None,
    progress: Progress | None = None,
) -> TrackedDataset:
    """Turn videos of one person into a dataset that an avatar is trained from.

    `videos` is a file that PyAV reads, a folder of images, or several of them in order. Writes
    the dataset to `dst`, with `tracking.json` (errors, rejected frames, speed) and `overlay.png`
    (the fitted mesh over frames). Frames without a face are left out and listed. The result is
    the same on every run. Raises UserError for unreadable input, no face, or no mediapipe.
    """
    config = config or TrackConfig()
    source = FrameSource.open(videos, config.max_frames)
    _refuse_used_folder(Path(dst), config.overwrite)
    work = _Work(progress, source.count_hint() or 0)
    seconds = _Stopwatch()
    seen = find_landmarks(source, work.advance)
    seconds.lap("landmarks")
    work.expect(3 * len(seen))
    tracker = SubjectTracker(HeadModel.embedded(dtype=torch.float64), config)
    fit = tracker.fit(seen.points_px, seen.follows(), seen.width, seen.height, work.advance)
    lost = tracker.rejected(fit, seen.points_px)
    found, fit = seen.without(lost), fit.without(lost)
    seconds.lap("fit")
    if not len(found):
        raise UserError(
            "The head model fits none of the faces that were found.",
            "Use a video in which the face is seen larger and more from the front.",
        )
    writer = DatasetWriter(
        dst,
        "makehuman",
        torch.from_numpy(fit.subject.identity).float(),
        tracker.head.layout,
        config.image_size,
        config.image_size,
        overwrite=config.overwrite,
    )
    crop = steady_crop(found.points_px, found.width, found.height, config.image_size)
    pictures = TrackedPictures(tracker, fit, found, crop, config.keep_torso)
    for frame in pictures.frames(source, work.advance):
        writer.add(frame)
    seconds.lap("pictures")
    write_contact_sheet(Path(dst) / "overlay.png", pictures.tiles, tracker.head.arrays.faces)
    report: dict[str, Any] = {
        "frames_read": seen.frames_read,
        "frames_tracked": len(found),
        "rejected": _rejections(seen, lost),
        "notes": list(source.notes),
        **fit_quality(tracker, fit, found.points_px),
        "seconds": seconds.laps,
        "frames_per_second": seen.frames_read / sum(seconds.laps.values()),
        "crop": {"left": crop.left, "top": crop.top, "side": crop.side},
    }
    write_report(Path(dst) / "tracking.json", report)
    test_frames = len(found) // 5 if config.test_frames is None else config.test_frames
    return writer.finish(test_frames)


def _refuse_used_folder(dst: Path, overwrite: bool) -> None:
    """Say at once what the writer would say after all the work."""
    if not overwrite and dst.is_dir() and any(dst.iterdir()):
        raise UserError(
            f"The folder {dst} is not empty.",
            "Name a new folder, or allow to overwrite the dataset in it.",
        )


class _Work:
    """Counts a frame's four units of work: landmarks, two fits, picture."""

    def __init__(self, progress: Progress | None, frames: int) -> None:
        self._progress = progress
        self._done, self._total = 0, 4 * frames

    def expect(self, units: int) -> None:
        """Correct the total once it is known what is left."""
        self._total = self._done + units

    def advance(self) -> None:
        """One unit more is done."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, max(self._total, self._done))


class _Stopwatch:
    """Seconds of each stage."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        """End a stage."""
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now


def _rejections(seen: ClipLandmarks, lost: Sequence[int]) -> dict[str, list[int]]:
    """Frames that are not in the dataset, by reason."""
    with_face = set(seen.frame_index)
    return {
        "no face": [index for index in range(seen.frames_read) if index not in with_face],
        "head does not fit": [seen.frame_index[position] for position in lost],
    }
