"""The tracker for a stream, on a still that is moved in known ways, and on a real clip."""

import threading
from contextlib import closing
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking import TrackConfig
from rgbavatar_ns.tracking.image.crop import FollowingCrop
from rgbavatar_ns.tracking.input.video import FrameSource

from .clips import REAL_CLIPS, astronaut

pytest.importorskip("mediapipe", reason="mediapipe is not installed")
from rgbavatar_ns.tracking.live import LiveTracker

CONFIG = TrackConfig(image_size=128, key_frames=3, identity_components=5, focal_px=400.0)
SIZE = 256


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    """Face about 90 pixels high, near the middle."""
    return np.ascontiguousarray(astronaut()[:SIZE, 66 : 66 + SIZE])


def _moved(image: np.ndarray, degrees: float = 0.0, right_px: float = 0.0) -> np.ndarray:
    """Turned counterclockwise about the middle, then shifted."""
    motion = cv2.getRotationMatrix2D((SIZE / 2 - 0.5, SIZE / 2 - 0.5), degrees, 1.0)
    motion[0, 2] += right_px
    return cv2.warpAffine(image, motion, (SIZE, SIZE), borderMode=cv2.BORDER_REPLICATE)


def test_a_focal_length_of_no_camera_is_told_with_the_first_picture() -> None:
    with (
        closing(LiveTracker(replace(CONFIG, focal_px=1.0))) as tracker,
        pytest.raises(UserError, match="1 pixels is no camera's"),
    ):
        tracker(np.zeros((120, 160, 3), np.uint8))


def test_roll_and_shift_of_a_still_come_back_as_rotation_and_translation(portrait):
    with closing(LiveTracker(CONFIG)) as tracker:
        for k in range(3):
            assert tracker(_moved(portrait, k - 1.0)) is None
        assert tracker.ready
        assert len(tracker.backlog()) == 3
        assert tracker.backlog() == []
        frames = {}
        for degrees in np.linspace(0, 12, 7):
            frames[degrees] = tracker(_moved(portrait, float(degrees)))
        for shift in np.linspace(0, 12, 7):
            moved = tracker(_moved(portrait, 12.0, float(shift)))
        layout = tracker.head.layout
    rotation, translation = layout.slice("rotation"), layout.slice("translation")
    first, last = frames[0.0], frames[12.0]
    assert first is not None
    assert last is not None
    assert moved is not None
    assert (first.index, last.index, moved.index) == (3, 9, 16)
    # Counterclockwise in the picture is positive about z, which comes out of the face.
    roll = torch.rad2deg(last.theta[rotation] - first.theta[rotation])
    assert roll[2].item() == pytest.approx(12, abs=1.5)
    assert roll[:2].abs().max() < 3
    camera = moved.camera
    depth = (camera.world_to_camera[0, 2, 3] - moved.theta[translation][2]).item()
    across = (moved.theta[translation] - last.theta[translation])[0].item()
    scale = camera.focal_px[0, 0].item() / depth
    assert across * scale / (CONFIG.image_size / _side(tracker)) == pytest.approx(12, abs=1.5)
    alpha = first.image_rgba[..., 3]
    assert alpha[0, 0] == 0
    assert alpha.max() == 255
    assert tracker.counts == {"tracked": 17}


def _side(tracker: LiveTracker) -> int:
    assert tracker._crop is not None
    return tracker._crop.square.side


def test_a_lost_face_is_counted_and_found_again(portrait):
    nothing = np.full((SIZE, SIZE, 3), 90, np.uint8)
    with closing(LiveTracker(CONFIG)) as tracker:
        assert tracker(nothing) is None
        for _ in range(3):
            tracker(portrait)
        assert tracker(nothing) is None
        found = None
        for _ in range(3):
            found = found or tracker(portrait)
    assert found is not None
    assert tracker.counts["no face"] >= 2


def test_mattes_of_pictures_without_a_face_do_not_queue_up(portrait, monkeypatch):
    nothing = np.full((SIZE, SIZE, 3), 90, np.uint8)
    go_on, begun = threading.Event(), []

    def slow(image_rgb, square):
        begun.append(image_rgb)
        go_on.wait(60)

    with closing(LiveTracker(CONFIG)) as tracker:
        for _ in range(3):
            tracker(portrait)
        with monkeypatch.context() as slowed:
            slowed.setattr(tracker, "_matted", slow)
            while tracker.counts["no face"] < 12:
                tracker(nothing)
            go_on.set()
        found = [tracker(portrait) for _ in range(3)]
        assert found[-1] is not None
    # One may have begun before it was known that nobody is there.
    assert len(begun) <= 1


def test_another_size_is_refused_and_identity_waits_for_the_warm_up(portrait):
    with closing(LiveTracker(CONFIG)) as tracker:
        tracker(portrait)
        with pytest.raises(RuntimeError, match="warm-up"):
            _ = tracker.identity
        with pytest.raises(UserError, match="changed from 256 x 256 to 200 x 256"):
            tracker(np.ascontiguousarray(portrait[:, :200]))


def test_the_crop_stands_until_the_head_leaves_it():
    face = np.zeros((1, 478, 2))
    face[0, :, 0] = np.linspace(300, 360, 478)
    face[0, :, 1] = np.linspace(200, 280, 478)
    face[0, 10], face[0, 152] = (330, 200), (330, 280)
    crop = FollowingCrop.around(face, 1000, 600, 128)
    before = crop.square
    crop.follow(face[0] + (6, -4))
    assert crop.square == before
    crop.follow(face[0] + (120, 0))
    assert crop.square.side == before.side
    assert crop.square.top == before.top
    assert crop.square.left + crop.square.side / 2 == pytest.approx(450, abs=2)


@pytest.mark.slow
@pytest.mark.skipif(not REAL_CLIPS.is_dir(), reason=f"no clips in {REAL_CLIPS}")
def test_a_real_clip_frame_by_frame_twice_the_same():
    images = [frame.image_rgb for frame in FrameSource.open(REAL_CLIPS / "grid_id2.mpg", 30)]

    def run():
        config = TrackConfig(image_size=128, key_frames=6, focal_px=576.0)
        with closing(LiveTracker(config)) as tracker:
            return [tracker(image) for image in images], tracker.identity, dict(tracker.counts)

    (frames, identity, counts), (again, same, _) = run(), run()
    assert counts == {"tracked": 30}
    assert frames[:6] == [None] * 6
    assert torch.equal(identity, same)
    for one, other in zip(frames[6:], again[6:]):
        assert torch.equal(one.theta, other.theta)
        np.testing.assert_array_equal(one.image_rgba, other.image_rgba)
