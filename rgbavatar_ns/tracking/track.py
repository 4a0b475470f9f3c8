"""A video in, a tracked dataset out: faces, fit, pictures, report; an interrupted run goes on."""

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.data import DatasetWriter, TrackedDataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.clip import ClipLandmarks, followed_face
from rgbavatar_ns.tracking.face.detector import load_mediapipe
from rgbavatar_ns.tracking.find_faces import find_faces
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.own_head import head_digest, read_own_head, subject_tracker
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.image.crop import SquareCrop, steady_crop
from rgbavatar_ns.tracking.image.frame_images import TrackedPictures
from rgbavatar_ns.tracking.input.mattes import UserMattes
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.resumable_run import ResumableRun, fingerprint, telling_of_the_disk
from rgbavatar_ns.tracking.verify.contact_sheet import write_sheet
from rgbavatar_ns.tracking.verify.report import (
    fit_quality,
    silhouette_summary,
    verdict,
    write_report,
)

Progress = Callable[[str, int, int | None], None]
"""Called with (stage, frames done, frames in all); None where a file does not say how many."""


def track_video(
    videos: Path | str | Sequence[Path | str],
    dst: Path | str,
    config: TrackConfig | None = None,
    progress: Progress | None = None,
) -> TrackedDataset:
    """Turn videos of one person into a dataset that an avatar is trained from.

    `videos` is a file that PyAV reads, a folder of images, or several of them in order. Writes
    the dataset to `dst`, with `tracking.json` (errors, rejected frames, speed, a verdict) and
    `overlay.png` (the fitted mesh over frames). Frames without the followed face are left out and
    listed. The head is the embedded one or `config.flame`, which the dataset then holds, as an
    imported one does. The result is the same on every run. An interrupted call leaves what it has
    done in `dst`; the same call goes on from there and ends with the same dataset. Raises
    UserError for unreadable input, no face, no mediapipe, a head model that is none, or a
    destination that cannot be used.
    """
    config = config or TrackConfig()
    own_head = read_own_head(config.flame)
    source = FrameSource.open(videos, config.max_frames)
    mattes = None if config.mattes is None else UserMattes.open(config.mattes, source)
    load_mediapipe()
    run = ResumableRun.open(Path(dst), _settings(source, config, own_head), config.overwrite)
    stages = _Stages(progress)
    with _one_thread_a_call():
        clip = _tracked_clip(source, mattes, own_head, config, run, stages)
        return _written(clip, source, mattes, config, run, stages)


@dataclass(frozen=True)
class _TrackedClip:
    """What is known before pictures are made; `lost` are frames whose head does not fit."""

    seen: ClipLandmarks
    found: ClipLandmarks
    lost: tuple[int, ...]
    tracker: SubjectTracker
    fit: ClipFit
    crop: SquareCrop
    source_alpha: bool


def _tracked_clip(
    source: FrameSource,
    mattes: UserMattes | None,
    own_head: HeadArrays | None,
    config: TrackConfig,
    run: ResumableRun,
    stages: "_Stages",
) -> _TrackedClip:
    hint = source.count_hint()
    stages.begin("faces", hint, run.frames_with_faces())
    with run.in_vain_if_it_fails():
        faces, width, height = find_faces(source, run, stages.done)
        seen = followed_face(faces, width, height)
        if mattes is not None:
            mattes.require_count(seen.frames_read, config.max_frames is not None)
        stages.begin("fit", len(seen))
        tracker = subject_tracker(config, own_head)
        fit = tracker.fit(seen.points_px, seen.follows(), width, height, stages.half_done)
        lost = tracker.rejected(fit, seen.points_px)
        found, fit = seen.without(lost), fit.without(lost)
        stages.done(len(seen))
        if not len(found):
            raise UserError(
                "The head model fits none of the faces that were found.",
                "Use a video in which the face is seen larger and more from the front.",
            )
    crop = steady_crop(found.points_px, width, height, config.image_size)
    left_out = tuple(seen.frame_index[position] for position in lost)
    alpha = mattes is None and bool(faces.has_alpha.any())
    return _TrackedClip(seen, found, left_out, tracker, fit, crop, alpha)


def _written(
    clip: _TrackedClip,
    source: FrameSource,
    mattes: UserMattes | None,
    config: TrackConfig,
    run: ResumableRun,
    stages: "_Stages",
) -> TrackedDataset:
    found, dst = clip.found, run.dst
    thetas = torch.from_numpy(clip.tracker.thetas(clip.fit)).float()
    identity = torch.from_numpy(clip.fit.subject.identity).float()
    noted = run.pictures(_name_of_fit(clip, thetas, identity))
    writer = DatasetWriter(
        dst,
        clip.tracker.head.arrays,
        identity,
        clip.tracker.head.layout,
        config.image_size,
        config.image_size,
        overwrite=True,
        keep_images=bool(noted),
    )
    pictures = TrackedPictures(
        clip.tracker, clip.fit, found, clip.crop, config.keep_torso, mattes, clip.source_alpha
    )
    ready = [k for k, index in enumerate(found.frame_index) if index in noted]
    stages.begin("pictures", len(found), len(ready))
    made = pictures.pictures(source, ready)
    for position, index in enumerate(found.frame_index):
        picture = None if index in noted else next(made)
        png = None if picture is None else picture.png
        with telling_of_the_disk(dst):
            writer.add_encoded(index, thetas[position], pictures.camera, png)
        if picture is not None:
            noted[index] = picture.agreement.to_json()
            run.note_picture(index, noted[index])
            stages.step()
    made.close()
    stages.end()
    with telling_of_the_disk(dst):
        write_sheet(dst, clip.tracker, clip.fit, found, clip.crop)
        report = _report(clip, source, mattes, [noted[k] for k in found.frame_index], stages)
        write_report(dst / "tracking.json", report)
        test_frames = len(found) // 5 if config.test_frames is None else config.test_frames
        dataset = writer.finish(test_frames)
    run.close()
    return dataset


def _name_of_fit(
    clip: _TrackedClip, thetas: Float[Tensor, "F H"], identity: Float[Tensor, "I"]
) -> str:
    """What a picture depends on beside the settings, in short."""
    digest = hashlib.sha256(repr((clip.crop, clip.fit.subject.camera)).encode())
    for values in (thetas.numpy(), identity.numpy(), np.array(clip.found.frame_index)):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _report(
    clip: _TrackedClip,
    source: FrameSource,
    mattes: UserMattes | None,
    noted: Sequence[dict[str, Any]],
    stages: "_Stages",
) -> dict[str, Any]:
    seen, crop = clip.seen, clip.crop
    with_face, with_others = set(seen.frame_index), set(seen.with_others)
    faceless = [index for index in range(seen.frames_read) if index not in with_face]
    tracked = set(clip.found.frame_index)
    given = "the user's mattes" if mattes is not None else "the source's alpha channel"
    report: dict[str, Any] = {
        "head_model": clip.tracker.head.arrays.name,
        "frames_read": seen.frames_read,
        "frames_tracked": len(clip.found),
        "rejected": {
            "no face": [index for index in faceless if index not in with_others],
            "only another face": [index for index in faceless if index in with_others],
            "head does not fit": list(clip.lost),
        },
        "segments": clip.found.segments(),
        "other_faces": list(seen.with_others),
        "blurred": [index for index in seen.blurred if index in tracked],
        "notes": list(source.notes),
        **fit_quality(clip.tracker, clip.fit, clip.found.points_px),
        **silhouette_summary(noted),
        "matte": given if mattes is not None or clip.source_alpha else "selfie segmentation",
        "stages": stages.report(),
        "frames_per_second": stages.frames_per_second(seen.frames_read),
        "crop": {"left": crop.left, "top": crop.top, "side": crop.side},
    }
    return {"verdict": verdict(report), **report}


def _settings(
    source: FrameSource, config: TrackConfig, own_head: HeadArrays | None
) -> dict[str, Any]:
    """What must be alike for a run to go on with what another one has done."""
    by_content = ("overwrite", "mattes", "flame")
    options = {name: value for name, value in asdict(config).items() if name not in by_content}
    mattes = config.mattes
    return {
        "the video": [fingerprint(path) for path in source.paths],
        "the mattes": None if mattes is None else fingerprint(Path(mattes)),
        "the head model": head_digest(own_head),
        **options,
        "the version of this program": version("rgbavatar-ns"),
    }


@contextmanager
def _one_thread_a_call() -> Iterator[None]:
    """OpenCV keeps to one thread: frames are what is done side by side, and the sums of its
    filters depend on how many threads share them."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


@dataclass
class _Stages:
    """Tells the progress of one stage after the other, and how long each one took."""

    progress: Progress | None
    _name: str = ""
    _total: int | None = None
    _first: int = 0
    _now: int = 0
    _halves: int = 0
    _began: float = 0.0
    _seconds: dict[str, float] = field(default_factory=dict)
    _frames: dict[str, int] = field(default_factory=dict)

    def begin(self, name: str, total: int | None, ready: int = 0) -> None:
        """End the stage before; of this one's frames, `ready` were done in an earlier run."""
        self.end()
        self._name, self._total, self._first, self._halves = name, total, ready, 0
        self._began = time.perf_counter()
        self.done(ready)

    def done(self, frames: int) -> None:
        """So many of the stage's frames are done."""
        self._now = frames
        if self.progress is not None:
            total = None if self._total is None else max(self._total, frames)
            self.progress(self._name, frames, total)

    def step(self) -> None:
        """One frame more is done."""
        self.done(self._now + 1)

    def half_done(self) -> None:
        """A frame has gone through one of two passes."""
        self._halves += 1
        self.done(self._halves // 2)

    def end(self) -> None:
        """Note down the stage's time."""
        if self._name:
            self._seconds[self._name] = time.perf_counter() - self._began
            self._frames[self._name] = self._now - self._first
            if self.progress is not None:
                self.progress(self._name, self._now, self._now)
        self._name = ""

    def report(self) -> dict[str, dict[str, float | int]]:
        """Of each stage the frames done in this run, seconds, and frames a second."""
        return {
            name: {
                "frames": self._frames[name],
                "seconds": seconds,
                "frames_per_second": self._frames[name] / seconds,
            }
            for name, seconds in self._seconds.items()
        }

    def frames_per_second(self, frames: int) -> float | None:
        """Of the whole run; None where some of it was done in an earlier run."""
        whole = all(count for count in self._frames.values())
        return frames / sum(self._seconds.values()) if whole else None
