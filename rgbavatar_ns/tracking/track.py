"""A video in, a tracked dataset out: faces, fit, images, report; an interrupted run goes on."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from threadpoolctl import threadpool_limits
from torch import Tensor

from rgbavatar_ns.data import DatasetWriter, TrackedDataset
from rgbavatar_ns.data.check.film import FilmFacts, film_facts
from rgbavatar_ns.data.check.problems import Problem, verdict
from rgbavatar_ns.data.check.report import quick_check
from rgbavatar_ns.data.check.sample import spread, take_sample
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import digest, disk_errors, write_json
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.clip import ClipLandmarks, followed_face, rate_notes
from rgbavatar_ns.tracking.face.detector import load_mediapipe
from rgbavatar_ns.tracking.face.find_faces import find_faces
from rgbavatar_ns.tracking.fit.camera import require_possible_focal
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.own_head import read_own_head, subject_tracker
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.image.background import Background
from rgbavatar_ns.tracking.image.body_end import BodyEnd
from rgbavatar_ns.tracking.image.crop import SquareCrop, steady_crop
from rgbavatar_ns.tracking.image.frame_images import FrameImages
from rgbavatar_ns.tracking.image.matting import PersonMatte
from rgbavatar_ns.tracking.image.outlines import key_outlines
from rgbavatar_ns.tracking.input.bars import Bars
from rgbavatar_ns.tracking.input.image_files import source_digest
from rgbavatar_ns.tracking.input.mattes import UserMattes
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.resumable_run import GO_ON, ResumableRun, alone_in
from rgbavatar_ns.tracking.stage_clock import Progress, StageClock
from rgbavatar_ns.tracking.torso.compose import on_body
from rgbavatar_ns.tracking.torso.find_body import find_body
from rgbavatar_ns.tracking.torso.place import BodyPlaces
from rgbavatar_ns.tracking.verify.contact_sheet import write_tracking_sheet
from rgbavatar_ns.tracking.verify.report import (
    fit_quality,
    silhouette_shares,
    silhouette_summary,
    tracking_findings,
)

_GLANCE_PX = 64
"""Longer side of a picture of which only the film's size is asked."""
_LIGHT_FRAMES = 60
"""Frames that tell how bright the film is and whether that changes."""
_MATTES = "with overlooked hair, the room of a moving camera, and nothing that is cut off"
"""How mattes are found: of something else an unfinished run makes its pictures anew."""


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
    UserError for unreadable input, no face, no mediapipe, or an unusable head or destination.
    """
    config = config or TrackConfig()
    own_head = read_own_head(config.flame)
    source = FrameSource.open(videos, config.max_frames).without_bars()
    for frame in source.these([] if config.focal_px is None else [0], _GLANCE_PX):
        require_possible_focal(config.focal_px, frame.width, frame.height)
    mattes = None if config.mattes is None else UserMattes.open(config.mattes, source)
    if mattes is not None:
        mattes.require_somebody(config.max_frames)
    load_mediapipe()
    settings = _settings(source, config, own_head)
    with alone_in(Path(dst)), _one_thread_a_call():
        run = ResumableRun.open(Path(dst), settings, config.overwrite)
        tracking = _Tracking(source, mattes, own_head, config, run, StageClock(progress))
        return tracking.write(tracking.fitted_clip())


@dataclass(frozen=True)
class _FittedClip:
    """What is known before images are made; `lost` are frames whose head does not fit."""

    seen: ClipLandmarks
    found: ClipLandmarks
    lost: tuple[int, ...]
    tracker: SubjectTracker
    fit: ClipFit
    body: BodyPlaces | None
    crop: SquareCrop
    source_alpha: bool
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Tracking:
    """One call of `track_video`."""

    source: FrameSource
    mattes: UserMattes | None
    own_head: HeadArrays | None
    config: TrackConfig
    run: ResumableRun
    clock: StageClock

    def fitted_clip(self) -> _FittedClip:
        """Find the face in every frame and fit the head to it."""
        config, clock = self.config, self.clock
        clock.begin("faces", self.source.count_hint())
        with self.run.in_vain_if_it_fails():
            faces, width, height = find_faces(self.source, self.run, clock.done)
            seen = followed_face(faces, width, height)
            if self.mattes is not None:
                self.mattes.require_count(seen.frames_read, config.max_frames is not None)
            clock.begin("outlines", seen.frames_read)
            tracker = subject_tracker(config, self.own_head)
            calls = count(1)  # two for each frame

            def half_done() -> None:
                clock.done(next(calls) // 2)

            alpha = self.mattes is None and bool(faces.has_alpha.mean() > 0.5)
            about_alpha = _alpha_notes(faces.has_alpha, alpha)
            notes = (*_bars_notes(self.source.bars), *self.source.notes, *about_alpha)
            notes = (*notes, *rate_notes(faces))
            keys = tracker.key_positions(seen.points_px, width, height)
            outlines = key_outlines(
                self.source, self.mattes, alpha, seen, keys, self.run, clock.done
            )
            clock.begin("fit", len(seen))
            follows = seen.follows()
            fit = tracker.fit(
                seen.points_px, follows, width, height, half_done, keys, outlines, seen.irises
            )
            lost = tracker.rejected(fit, seen.points_px)
            found, fit = seen.without(lost), fit.without(lost)
            clock.done(len(seen))
            if not len(found):
                raise UserError(
                    "The head model fits none of the faces that were found.",
                    "Use a video in which the face is seen larger and more from the front.",
                )
        self._held_out(len(found))
        body = None
        if tracker.head.arrays.has_torso:
            given = (self.mattes, alpha)
            with closing(PersonMatte()) as person:
                body = find_body(
                    self.source, self.run, tracker, fit, found, *given, person.coarse, clock
                )
            arrays, heads = tracker.head.arrays, tracker.thetas(fit)
            alone = fit.subject.identity
            identity, upon = on_body(tracker.mesh_landmarks, arrays, alone, heads, body)
            fit = replace(fit, subject=replace(fit.subject, identity=identity), upon_body=upon)
        crop = steady_crop(
            found.points_px, width, height, config.image_size, with_body=body is not None
        )
        left_out = tuple(seen.frame_index[position] for position in lost)
        return _FittedClip(seen, found, left_out, tracker, fit, body, crop, alpha, notes)

    def _held_out(self, frames: int) -> int:
        """How many of the last frames are held out; UserError where none would be left."""
        test = self.config.test_frames
        if test is None:
            test = max(1, frames // 5) if frames > 1 else 0
        if test >= frames:
            raise UserError(
                f"{test} of {frames} tracked frames cannot be held out.",
                "Name a smaller --test-frames: what was found so far is kept.",
            )
        return test

    def write(self, clip: _FittedClip) -> TrackedDataset:
        """Make the images that are missing, and the dataset with its report."""
        found, dst = clip.found, self.run.dst
        arrays, layout = clip.tracker.head.arrays, clip.tracker.head.layout
        thetas = torch.from_numpy(clip.tracker.thetas(clip.fit)).float()
        identity = torch.from_numpy(clip.fit.subject.identity).float()
        images = FrameImages(
            clip.tracker,
            clip.fit,
            found,
            clip.crop,
            self.mattes,
            clip.source_alpha,
        )
        made_from = _digest_of_fit(clip, thetas, identity, images.body_end)
        noted = self.run.noted_images(made_from)
        background = self._background(images, made_from) if images.finds_mattes else None
        with disk_errors(dst, GO_ON):
            size, keep = clip.crop.size, bool(noted)
            rate = found.frames_per_second
            writer = DatasetWriter(
                dst, arrays, identity, layout, size, size, True, keep, frames_per_second=rate
            )
        self._write_images(clip, thetas, images, background, writer, noted)
        frames, clock = len(found), self.clock
        clock.begin("report", frames)
        with disk_errors(dst, GO_ON):
            clock.done(0)
            bare_px = clip.tracker.fitted_px(clip.fit, with_offsets=False)
            write_tracking_sheet(dst, clip.tracker, clip.fit, bare_px, found, clip.crop)
            clock.done(frames // 4)
            dataset = writer.finish(self._held_out(frames))
            clock.done(frames // 2)
            quality = fit_quality(clip.tracker, clip.fit, bare_px, found.points_px, found.irises)
            shares = [noted[index] for index in found.frame_index]
            refused = quick_check(dataset)
            report = self._report(clip, background, quality, shares, refused)
            clock.done(3 * frames // 4)
            report["film"] = _film_shown(dataset, report).to_json()
            write_json(dst / "tracking.json", report)
            clock.done(frames)
        clock.end()
        self.run.close()
        return dataset

    def _background(self, images: FrameImages, made_from: str) -> Background:
        """What is behind the person, looked at once; kept in the work folder."""

        def look(key: str) -> str:
            self.clock.begin("background", None)
            found = images.background(self.source, self.clock.done)
            name = f"background_{key[:16]}.npz"
            found.save(self.run.folder / name, GO_ON)
            return name

        name = self.run.stages.run("background and its edges", made_from, look)
        return Background.load(self.run.folder / name)

    def _write_images(
        self,
        clip: _FittedClip,
        thetas: Float[Tensor, "F H"],
        images: FrameImages,
        background: Background | None,
        writer: DatasetWriter,
        noted: dict[int, dict[str, Any]],
    ) -> None:
        """Every frame's image, but for those that are noted; what is made is noted too."""
        found, crop = clip.found, clip.crop
        camera = crop.pinhole(clip.fit.subject.camera)
        ready = [k for k, index in enumerate(found.frame_index) if index in noted]
        self.clock.begin("pictures", len(found))
        done = len(ready)
        self.clock.done(done)
        with closing(images(self.source, background, ready)) as made:
            for index, theta in zip(found.frame_index, thetas):
                image = None if index in noted else next(made)
                unfilmed = noted[index]["unfilmed"] if image is None else image.unfilmed
                png = None if image is None else image.png
                with disk_errors(self.run.dst, GO_ON):
                    writer.add_encoded(index, theta, camera, png, has_unfilmed=unfilmed > 0)
                if image is not None:
                    shares = silhouette_shares(image.outline, image.matte, image.inside)
                    noted[index] = {**shares, "unfilmed": unfilmed}
                    self.run.note_image(index, noted[index])
                    done += 1
                    self.clock.done(done)
        self.clock.end()

    def _report(
        self,
        clip: _FittedClip,
        background: Background | None,
        quality: dict[str, Any],
        shares: Sequence[dict[str, Any]],
        refused: Sequence[Problem],
    ) -> dict[str, Any]:
        """What `tracking.json` holds; `refused` is why the dataset cannot be trained on."""
        seen, found, crop = clip.seen, clip.found, clip.crop
        with_others, tracked = set(seen.with_others), set(found.frame_index)
        faceless = sorted(set(range(seen.frames_read)) - set(seen.frame_index))
        given = "the user's mattes" if self.mattes is not None else "the source's alpha channel"
        own_mattes = self.mattes is not None or clip.source_alpha
        report: dict[str, Any] = {
            "head_model": clip.tracker.head.arrays.name,
            "frames_read": seen.frames_read,
            "frames_tracked": len(found),
            "rejected": {
                "no face": [index for index in faceless if index not in with_others],
                "only another face": [index for index in faceless if index in with_others],
                "head does not fit": list(clip.lost),
            },
            "segments": found.segments(),
            "other_faces": list(seen.with_others),
            "blurred": [index for index in seen.blurred if index in tracked],
            "notes": list(clip.notes),
            **quality,
            **silhouette_summary(shares),
            "unfilmed_share": sum(one["unfilmed"] for one in shares) / len(shares),
            "matte": given if own_mattes else "selfie segmentation",
            **({} if background is None else background.report()),
            "stages": self.clock.stages,
            "frames_per_second": self.clock.frames_per_second(seen.frames_read),
            "body": None if clip.body is None else clip.body.report(),
            "crop": {"left": crop.left, "top": crop.top, "side": crop.side},
            "refused": [problem.to_json() for problem in refused],
        }
        return {"verdict": verdict([*refused, *tracking_findings(report)]), **report}


def _alpha_notes(has_alpha: Bool[np.ndarray, "F"], used: bool) -> list[str]:
    """What is to be known where some frames are transparent around the person and others not."""
    count, frames = int(has_alpha.sum()), len(has_alpha)
    if count in (0, frames):
        return []
    rest = "of the others all is taken for the person" if used else "so it is not used"
    return [f"{count} of {frames} frames have an alpha channel; {rest}"]


def _bars_notes(bars: Bars) -> list[str]:
    """What was cut off the film before anything was looked for."""
    sides = [
        f"{px} pixels {where}" for where, px in zip(("left", "above", "right", "below"), bars) if px
    ]
    return [f"bars around the film are cut off: {', '.join(sides)}"] if sides else []


def _film_shown(dataset: TrackedDataset, report: dict[str, Any]) -> FilmFacts:
    """What the film shows and lacks, from its dataset and from what only tracking knows."""
    some = take_sample(dataset, spread(len(dataset), _LIGHT_FRAMES).tolist())
    blurred = len(report["blurred"]) / report["frames_tracked"]
    return film_facts(dataset, some, report["face_height_px"], blurred)


def _digest_of_fit(
    clip: _FittedClip,
    thetas: Float[Tensor, "F H"],
    identity: Float[Tensor, "I"],
    body_end: BodyEnd | None,
) -> str:
    """What an image depends on beside the settings, in short."""
    camera = clip.fit.subject.camera
    fixed = repr((clip.crop, camera, clip.found.frame_index, UNFILMED_RGBA, _MATTES))
    if body_end is not None:
        fixed += f"{body_end.height_m:.6f} {body_end.fade_m:.6f}"
    return digest([fixed, thetas.numpy(), identity.numpy()])


def _settings(
    source: FrameSource, config: TrackConfig, own_head: HeadArrays | None
) -> dict[str, Any]:
    """What must be alike for a run to go on with what another one has done."""
    # By their content, or decided at the end.
    apart = ("overwrite", "mattes", "flame", "test_frames")
    options = {name: value for name, value in asdict(config).items() if name not in apart}
    mattes = config.mattes
    return {
        "the video": [source_digest(path) for path in source.paths],
        "the mattes": None if mattes is None else source_digest(Path(mattes)),
        **({"the bars around the film": list(source.bars)} if any(source.bars) else {}),
        "the head model": None if own_head is None else own_head.digest(),
        **options,
        "the version of this program": version("rgbavatar-ns"),
    }


@contextmanager
def _one_thread_a_call() -> Iterator[None]:
    """OpenCV and the matrices keep to one thread: frames are what is done side by side.

    The sums of filters depend on how many threads share them, and matrices are so small that more
    threads only wait for each other: on a busy machine for most of the time.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)
