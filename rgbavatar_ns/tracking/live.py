"""The tracker for a stream: one frame in, one tracked frame out."""

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, UInt8
from threadpoolctl import ThreadpoolController
from torch import Tensor

from rgbavatar_ns.data import TrackedFrame
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.detector import FaceLandmarker
from rgbavatar_ns.tracking.face.iris import FoundIrises, find_irises
from rgbavatar_ns.tracking.fit.camera import require_possible_focal
from rgbavatar_ns.tracking.fit.fit import (
    STEPS_ANEW,
    ClipFit,
    SubjectFit,
    fit_frame,
    rigid_start,
)
from rgbavatar_ns.tracking.fit.outline import PersonOutline
from rgbavatar_ns.tracking.fit.own_head import read_own_head, subject_tracker
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.image.crop import FollowingCrop, SquareCrop, steady_crop
from rgbavatar_ns.tracking.image.cut_out import CutOut, MattedCrop
from rgbavatar_ns.tracking.image.matting import PersonMatte
from rgbavatar_ns.tracking.image.outlines import OUTLINE_PX, levels, person_outline

# Share of a clip's pull to both neighbours: a stream has only the past, and must not lag.
_CAUSAL_SHARE = 0.25
# Fewer steps than a clip's frames get, since the next frame goes on.
_STEPS_ONWARD = (2, 2)
_SIZE_PX = 512

_Image = UInt8[np.ndarray, "H W 3"]
_Landmarks = Float[np.ndarray, "478 2"]
_Values = Float[np.ndarray, "P"]


class LiveTracker:
    """Follows one person in a stream, with the models and the fit of `track_video`.

    The first `config.key_frames` frames that show the face give identity and crop:
    until then `ready` is False and calls return None. `backlog` hands these frames out afterwards,
    tracked, so that none is lost. Every later call fits one frame, starting from the one before
    and drawn a little towards it. The square that is cut out stays where it is until the head
    leaves it; each frame carries its own camera. The result depends on the frames alone.

    Call `close` at the end. `counts` says how many frames were "tracked", had
    "no face", or a head that "does not fit".
    """

    def __init__(self, config: TrackConfig | None = None) -> None:
        # A stream has its head alone: how a body moves is known from the clip as a whole.
        self._config = replace(config or TrackConfig(), head_only=True)
        self._tracker = subject_tracker(self._config, read_own_head(self._config.flame))
        self.head = self._tracker.head
        self._landmarker = FaceLandmarker()
        self._matte = PersonMatte()
        self._cut_out = CutOut(self.head.arrays)
        self._worker = ThreadPoolExecutor(1, "rgbavatar-matte")
        self._warm_up: list[tuple[int, _Image, _Landmarks, FoundIrises]] = []
        self._backlog: list[TrackedFrame] = []
        self._fit: _CausalFit | None = None
        self._crop: FollowingCrop | None = None
        self._size: tuple[int, int] | None = None
        self._libraries = ThreadpoolController()  # to look for them takes milliseconds
        self._next_index = 0
        self.counts: Counter[str] = Counter()

    def close(self) -> None:
        """Free mediapipe's graphs and the worker thread."""
        self._worker.shutdown()
        self._landmarker.close()
        self._matte.close()

    @property
    def ready(self) -> bool:
        """Whether the subject is known and frames are tracked."""
        return self._fit is not None

    @property
    def identity(self) -> Float[Tensor, "I"]:
        """The subject's identity coefficients; RuntimeError before `ready`."""
        if self._fit is None:
            raise RuntimeError("The subject is not known before the warm-up's end (`ready`).")
        return torch.from_numpy(self._fit.subject.identity).float()

    def backlog(self) -> list[TrackedFrame]:
        """The tracked frames of the warm-up, once: a second call gives an empty list."""
        taken, self._backlog = self._backlog, []
        return taken

    def __call__(self, image_rgb: _Image, index: int | None = None) -> TrackedFrame | None:
        """Track one frame; None without a usable face, and during the warm-up.

        `index` numbers the frame; without it frames are counted from 0. Raises UserError when the
        frames' size changes: they share a camera.
        """
        index = self._next_index if index is None else index
        self._next_index = index + 1
        self._require_size(image_rgb.shape[1], image_rgb.shape[0])
        # Small matrices: more threads would only wait for each other.
        with self._libraries.limit(limits=1, user_api="blas"):
            if self._fit is None or self._crop is None:
                if self._collected(index, image_rgb):
                    self._track_warm_up(*self._meet())
                return None
            square = self._crop.square
            matted = self._worker.submit(self._matted, image_rgb, square)
            landmarks = self._landmarker(image_rgb)
            if landmarks is None:
                # Not begun, mostly: else mattes of nobody would queue up, and their pictures.
                matted.cancel()
                self._fit.forget()
                self.counts["no face"] += 1
                return None
            irises = find_irises(image_rgb, landmarks)
            frame = self._tracked(self._fit, index, landmarks, irises, square, matted.result)
            self._crop.follow(landmarks)
            return frame

    def pose(self, image_rgb: _Image, index: int = 0) -> Float[Tensor, "H"] | None:
        """The frame's theta alone, where no picture of the person is wanted; None as a call gives.

        The warm-up's frames are in `pose_backlog`, by the numbers that they were given here.
        """
        self._require_size(image_rgb.shape[1], image_rgb.shape[0])
        with self._libraries.limit(limits=1, user_api="blas"):
            if self._fit is None:
                if self._collected(index, image_rgb):
                    self._meet()
                return None
            landmarks = self._landmarker(image_rgb)
            if landmarks is None:
                self._fit.forget()
                self.counts["no face"] += 1
                return None
            return self._pose(self._fit, landmarks, find_irises(image_rgb, landmarks))

    def pose_backlog(self) -> list[tuple[int, Float[Tensor, "H"]]]:
        """Theta of the warm-up's frames by their numbers, once; nothing before `ready`."""
        if self._fit is None:
            return []
        numbered = [(index, (points, eyes)) for index, _, points, eyes in self._warm_up]
        self._warm_up = []
        with self._libraries.limit(limits=1, user_api="blas"):
            posed = [(index, self._pose(self._fit, *found)) for index, found in numbered]
        return [(index, theta) for index, theta in posed if theta is not None]

    def _pose(
        self, fit: "_CausalFit", landmarks_px: _Landmarks, irises: FoundIrises
    ) -> Float[Tensor, "H"] | None:
        values = fit(landmarks_px, irises)
        if values is None:
            self.counts["does not fit"] += 1
            return None
        return self._theta(fit, values)

    def _require_size(self, width: int, height: int) -> None:
        if self._size is not None and self._size != (width, height):
            raise UserError(
                f"The stream's frames changed from {self._size[0]} x {self._size[1]} "
                f"to {width} x {height} pixels.",
                "Keep one size, or start a new tracker: all frames share a camera.",
            )
        if self._size is None:
            require_possible_focal(self._config.focal_px, width, height)
        self._size = (width, height)

    def _collected(self, index: int, image_rgb: _Image) -> bool:
        """Take a frame into the warm-up; whether these are enough to meet the subject."""
        landmarks = self._landmarker(image_rgb)
        if landmarks is None:
            self.counts["no face"] += 1
            return False
        irises = find_irises(image_rgb, landmarks)
        self._warm_up.append((index, image_rgb.copy(), landmarks, irises))
        return len(self._warm_up) >= self._config.key_frames

    def _meet(self) -> "tuple[_CausalFit, FollowingCrop]":
        """Fit the subject to the warm-up's frames; from now on frames are tracked."""
        seen = self._warm_up
        landmarks = np.stack([points for _, _, points, _ in seen])
        irises = FoundIrises.stacked([one for *_, one in seen])
        height, width = seen[0][1].shape[:2]
        keys = self._tracker.key_positions(landmarks, width, height)
        outlines = self._outlines(landmarks, [image for _, image, _, _ in seen], keys)
        subject = self._tracker.fit_subject(landmarks, width, height, keys, outlines, irises)
        self._fit = _CausalFit(self._tracker, subject)
        size = self._config.image_size or _SIZE_PX
        self._crop = FollowingCrop.around(landmarks, width, height, size)
        return self._fit, self._crop

    def _track_warm_up(self, fit: "_CausalFit", crop: FollowingCrop) -> None:
        """Track the frames that the subject was met in."""
        seen, self._warm_up = self._warm_up, []
        for index, image, landmarks_px, found in seen:
            matted = partial(self._matted, image, crop.square)
            frame = self._tracked(fit, index, landmarks_px, found, crop.square, matted)
            if frame is not None:
                self._backlog.append(frame)

    def _outlines(
        self,
        landmarks: Float[np.ndarray, "F 478 2"],
        images: Sequence[_Image],
        keys: Sequence[int],
    ) -> list[PersonOutline | None]:
        """The person's outlines in the key frames of the warm-up."""
        height, width = images[0].shape[:2]
        crop = steady_crop(landmarks, width, height, OUTLINE_PX)
        outlines = []
        for position in keys:
            matte = levels(self._matte(crop.apply(images[position])))
            outlines.append(person_outline(matte, crop, landmarks[position]))
        return outlines

    def _matted(self, image_rgb: _Image, crop: SquareCrop) -> MattedCrop:
        image, (height, width) = crop.apply(image_rgb), image_rgb.shape[:2]
        return MattedCrop.of(image, self._matte(image), crop.inside(width, height))

    def _tracked(
        self,
        fit: "_CausalFit",
        index: int,
        landmarks_px: _Landmarks,
        irises: FoundIrises,
        crop: SquareCrop,
        matted: Callable[[], MattedCrop],
    ) -> TrackedFrame | None:
        """Fit the head, then cut it out of what `matted` waits for."""
        values = fit(landmarks_px, irises)
        if values is None:
            matted()
            self.counts["does not fit"] += 1
            return None
        one = ClipFit(fit.subject, values[None])
        vertices_px = crop.points(self._tracker.vertices_px(one, 0))
        outline = self._cut_out.outline(crop.size, vertices_px, crop.points(landmarks_px))
        rgba = self._cut_out(matted(), outline, vertices_px)
        theta = self._theta(fit, values)
        return TrackedFrame(index, theta, crop.pinhole(fit.subject.camera), rgba)

    def _theta(self, fit: "_CausalFit", values: _Values) -> Float[Tensor, "H"]:
        self.counts["tracked"] += 1
        one = ClipFit(fit.subject, values[None])
        return torch.from_numpy(self._tracker.thetas(one)[0]).float()


class _CausalFit:
    """Fits one frame after the other for a known subject."""

    def __init__(self, tracker: SubjectTracker, subject: SubjectFit) -> None:
        self.subject = subject
        self._tracker = tracker
        head = tracker.cost.head.of_person(subject.identity)
        self._cost = replace(tracker.cost, head=head)
        self._weight = _CAUSAL_SHARE * tracker.config.temporal_weight
        self._previous: _Values | None = None

    def forget(self) -> None:
        """A gap: the next frame starts anew."""
        self._previous = None

    def __call__(self, landmarks_px: _Landmarks, irises: FoundIrises) -> _Values | None:
        """The frame's fitted entries of theta; None where no pose of the head explains it."""
        camera, before = self.subject.camera, self._previous
        target = self._tracker.targets(landmarks_px[None], FoundIrises.stacked([irises]))[0]
        start = rigid_start(self._cost, camera, target) if before is None else before
        steps = STEPS_ANEW if before is None else _STEPS_ONWARD
        values = fit_frame(self._cost, camera, target, start, before, self._weight, steps)
        lost = self._tracker.rejected(ClipFit(self.subject, values[None]), landmarks_px[None])
        self._previous = None if lost else values
        return self._previous
