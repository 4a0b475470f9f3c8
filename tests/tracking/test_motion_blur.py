"""Frames that were exposed while the head moved: followed, and noted as blurred."""

from collections.abc import Sequence
from contextlib import closing

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.clip import ClipLandmarks, SeenFaces, followed_face
from rgbavatar_ns.tracking.face.detector import FaceLandmarker
from rgbavatar_ns.tracking.face.find_faces import sharpness
from rgbavatar_ns.tracking.face.iris import FoundIrises, find_irises
from rgbavatar_ns.tracking.fit.own_head import subject_tracker

from .acting import degrees_apart, skulls
from .clips import astronaut

pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")


def follow(pictures: Sequence[np.ndarray]) -> ClipLandmarks:
    """The face as `rgbavatar track` sees it, frame after frame."""
    height, width = pictures[0].shape[:2]
    points, irises, sigmas, found, sharp = [], [], [], [], []
    with closing(FaceLandmarker()) as landmarker:
        for picture in pictures:
            faces = landmarker.faces(picture)
            found.append(len(faces))
            points.append(faces)
            eyes = [find_irises(picture, face * (width, height)) for face in faces]
            irises.append(FoundIrises.stacked(eyes).centers / (width, height))
            sigmas.append(FoundIrises.stacked(eyes).sigma)
            sharp += [sharpness(picture, face) for face in faces]
    count = len(pictures)
    seen = SeenFaces(
        np.array(found, dtype=np.int64),
        np.zeros(count, np.int64),
        np.full(count, np.nan),
        np.zeros(count, bool),
        np.concatenate(points),
        np.concatenate(irises),
        np.concatenate(sigmas),
        np.array(sharp),
    )
    return followed_face(seen, width, height)


def test_a_face_swept_through_the_picture_is_found_and_noted_as_blurred() -> None:
    portrait = cv2.copyMakeBorder(astronaut(), 0, 0, 120, 120, cv2.BORDER_REPLICATE)
    across_px = np.concatenate([np.arange(-60, -36, 6), np.arange(-30, 66, 24)])
    swept = np.arange(len(across_px)) >= 4
    # The shutter is open for two thirds of a frame: a sixth of the face's width.
    sharp = [np.roll(portrait, int(shift), axis=1) for shift in across_px]
    blurred = [cv2.blur(p, (16, 1)) if fast else p for p, fast in zip(sharp, swept)]
    clips = [follow(pictures) for pictures in (sharp, blurred)]
    assert [clip.frame_index for clip in clips] == [tuple(range(len(sharp)))] * 2
    assert clips[0].blurred == ()
    assert clips[1].blurred == tuple(np.flatnonzero(swept)), "half of the frames, and yet told"


FRAMES, EXPOSURES, SIZE = 16, 7, 128
_FAST = slice(6, 12)
"""Frames in which the head swings and nods, at up to 300 degrees a second of a 25 Hz video."""


def _swinging(layout: ThetaLayout, time_frames: np.ndarray) -> np.ndarray:
    theta = np.zeros((len(time_frames), layout.size))
    seconds = time_frames / 25
    speed = np.clip((time_frames - _FAST.start + 1) / 2, 0, 1)
    speed *= np.clip((_FAST.stop - time_frames) / 2, 0, 1)
    rotation, shift = layout.slice("rotation").start, layout.slice("translation").start
    theta[:, rotation] = speed * 0.12 * np.sin(2 * np.pi * 3 * seconds + 1)
    slow = 0.08 * np.sin(2 * np.pi * 0.7 * seconds)
    theta[:, rotation + 1] = slow + speed * 0.38 * np.sin(2 * np.pi * 2.2 * seconds)
    theta[:, shift] = speed * 0.03 * np.sin(2 * np.pi * 2.2 * seconds + 0.5)
    return theta


@pytest.mark.slow
def test_a_swinging_head_is_followed_through_frames_exposed_for_half_their_time() -> None:
    config = DemoConfig(
        image_size=SIZE,
        num_frames=FRAMES,
        num_test_frames=1,
        seed=5,
        glasses=False,
        supersampling=1,
    )
    person = DemoPerson.of(config)
    layout = person.head.layout
    pictures = []
    for frame in range(FRAMES):
        exposures = EXPOSURES if _FAST.start <= frame < _FAST.stop else 1
        moments = frame + 0.5 * ((np.arange(exposures) + 0.5) / exposures - 0.5)
        theta = torch.from_numpy(_swinging(layout, moments)).float()
        light = np.zeros((SIZE, SIZE, 3))
        for image in person.draw(theta):
            alpha = image[..., 3:] / 255
            light += image[..., :3] * alpha + 120 * (1 - alpha)
        pictures.append((light / exposures).round().astype(np.uint8))
    clip = follow(pictures)
    assert clip.frame_index == tuple(range(FRAMES)), "every frame is found"
    focal_px = person.camera.focal_px
    known = TrackConfig(focal_px=focal_px, key_frames=4, identity_components=8, head_only=True)
    tracker = subject_tracker(known)
    fit = tracker.fit(clip.points_px, clip.follows(), SIZE, SIZE, irises=clip.irises)
    assert tracker.rejected(fit, clip.points_px) == []
    true = _swinging(layout, np.arange(FRAMES, dtype=float))
    away = degrees_apart(skulls(tracker, tracker.thetas(fit)), skulls(tracker, true))
    fast = np.zeros(FRAMES, bool)
    fast[_FAST] = True
    print(f"degrees: still {away[~fast].mean():.2f}, moving {away[fast].mean():.2f}", clip.blurred)
    assert away[fast].mean() < away[~fast].mean() + 2.0
    assert away.max() < 7.0
    assert set(clip.blurred) <= set(np.flatnonzero(fast))
    assert len(clip.blurred) >= 3
