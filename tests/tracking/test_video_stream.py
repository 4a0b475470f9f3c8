"""Videos and cameras as streams, with a tracker that only counts, and with the real one."""

import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import TrackedFrame
from rgbavatar_ns.data.streams import Backoff
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.tracking.input.capture import CapturedFrame, FileCapture, LatestFrameCapture
from rgbavatar_ns.tracking.video_stream import VideoStream

from ..data.streaming import DEADLINE_S, take
from .clips import REAL_CLIPS, gradient_images, write_clip

SIZE = 8
CAMERA = PinholeCameras(torch.eye(4)[None], torch.ones(1, 2), torch.zeros(1, 2), SIZE, SIZE)


class CountingTracker:
    """Meets the subject at the third picture; sees no face in dark ones."""

    def __init__(self) -> None:
        self.head = HeadModel.embedded()
        self.counts: Counter[str] = Counter()
        self.identity = torch.zeros(self.head.num_identity)
        self.ready = self.closed = False
        self._warm_up: list[TrackedFrame] = []
        self._shape: tuple[int, ...] | None = None

    def backlog(self) -> list[TrackedFrame]:
        taken, self._warm_up = self._warm_up, []
        return taken

    def __call__(self, image_rgb: np.ndarray, index: int | None = None) -> TrackedFrame | None:
        if self._shape not in (None, image_rgb.shape):
            raise UserError("Another size.", "Keep one.")
        self._shape = image_rgb.shape
        if image_rgb.mean() < 1:
            self.counts["no face"] += 1
            return None
        assert index is not None
        theta = torch.full((self.head.layout.size,), float(index))
        image = np.full((SIZE, SIZE, 4), index, np.uint8)
        frame = TrackedFrame(index, theta, CAMERA, image)
        if self.ready:
            return frame
        self._warm_up.append(frame)
        self.ready = len(self._warm_up) == 3
        return None

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return write_clip(tmp_path / "clip.mp4", gradient_images(8))


def test_a_file_is_tracked_frame_by_frame_in_its_own_time(clip: Path):
    tracker = CountingTracker()
    stream = VideoStream(str(clip), tracker=tracker)
    began = time.monotonic()
    who = stream.subject(DEADLINE_S)
    assert who is not None
    assert (who.width, who.height) == (SIZE, SIZE)
    frames = take(stream, 100)
    # The last of eight frames at 25 a second is due after 7 / 25 s.
    assert time.monotonic() - began >= 0.27
    assert [frame.index for frame in frames] == list(range(8))
    assert all(int(f.decode().image_rgba[0, 0, 0]) == f.index for f in frames)
    assert stream.ended
    assert stream.keeps_frames
    stream.close()
    assert tracker.closed


def test_a_file_goes_on_in_its_middle_with_the_same_subject(clip: Path):
    stream = VideoStream(str(clip), tracker=CountingTracker())
    stream.go_on_after(5)
    assert [frame.index for frame in take(stream, 100)] == [6, 7]
    late = VideoStream(str(clip), tracker=CountingTracker())
    assert late.subject(DEADLINE_S) is not None
    late.go_on_after(1)
    assert [frame.index for frame in take(late, 100)] == [2, 3, 4, 5, 6, 7]


def test_a_file_is_one_session_whenever_it_is_read_and_another_file_is_another(
    clip: Path, tmp_path: Path
):
    other = write_clip(tmp_path / "other.mp4", gradient_images(9))

    def session(path: Path) -> str:
        return take(VideoStream(str(path), tracker=CountingTracker()), 1)[0].session

    assert session(clip) == session(clip) != session(other)


def test_what_is_passed_over_is_not_waited_for(tmp_path: Path):
    # Half a minute apart, but for the last two.
    times = [0, 30_000, 60_000, 90_000, 120_000, 120_300]
    clip = write_clip(tmp_path / "clip.mkv", gradient_images(6), "ffv1", times_ms=times)
    stream = VideoStream(str(clip), tracker=CountingTracker())
    stream.go_on_after(4)
    began = time.monotonic()
    assert [frame.index for frame in take(stream, 100)] == [5]
    assert 0.3 <= time.monotonic() - began < 20
    capture = FileCapture(clip)
    assert capture.next(0.0) is not None
    assert capture.next(0.0) is None
    capture.pass_over(3)
    assert [one.index for _ in range(3) if (one := capture.next(0.0)) is not None] == [1, 2, 3]
    assert capture.next(0.0) is None


class FakeCamera:
    """Gives some images, one for each of `steps`, then nothing."""

    def __init__(
        self, images: list[np.ndarray], steps: threading.Semaphore, opened: bool = True
    ) -> None:
        self._images, self._steps, self._opened = images, steps, opened
        self.released, self.waits = False, threading.Event()

    def isOpened(self) -> bool:
        return self._opened

    def read(self) -> tuple[bool, np.ndarray | None]:
        if not self._images:
            return False, None
        if not self._steps.acquire(blocking=False):
            self.waits.set()
            assert self._steps.acquire(timeout=DEADLINE_S)
        return True, self._images.pop(0)

    def release(self) -> None:
        self.released = True


class SteppedCapture(LatestFrameCapture):
    """Lets its camera go on when a frame was taken, so that none is skipped."""

    def __init__(self, steps: threading.Semaphore, *given: Any) -> None:
        self._steps = steps
        super().__init__("0", *given)

    def next(self, timeout_s: float) -> CapturedFrame | None:
        frame = super().next(timeout_s)
        if frame is not None:
            self._steps.release()
        return frame


def lit(level: int, side: int = 4) -> np.ndarray:
    return np.full((side, side, 3), level, np.uint8)


def test_a_lost_camera_is_opened_again_and_faceless_images_are_counted():
    steps = threading.Semaphore(1)
    cameras = [
        FakeCamera([lit(50), lit(60), lit(70), lit(0)], steps),
        FakeCamera([], steps, opened=False),
        FakeCamera([lit(80), lit(90, side=6), lit(100), *[lit(110)] * 9], steps),
    ]
    opened = iter(cameras)
    capture = SteppedCapture(steps, lambda _: next(opened), Backoff(0.01, 0.02))
    stream = VideoStream("0", tracker=CountingTracker(), capture=capture)
    frames = take(stream, 6)
    assert [frame.index for frame in frames] == [0, 1, 2, 4, 6, 7]
    counts = stream.counts
    assert counts["source lost"] == counts["reconnects"] == counts["failed openings"] == 1
    assert (counts["no face"], counts["another resolution"], counts["skipped"]) == (1, 1, 0)
    assert not stream.keeps_frames
    assert len({frame.session for frame in frames}) == 1
    assert frames[0].session
    steps.release()
    stream.close()
    assert stream.ended
    assert all(camera.released for camera in cameras)


def test_a_camera_that_comes_back_with_another_size_is_told():
    steps = threading.Semaphore(1)
    back = [lit(80, side=6)] * 49 + [lit(90)] + [lit(80, side=6)] * 50
    cameras = [FakeCamera([lit(50), lit(60), lit(70)], steps), FakeCamera(back, steps)]
    opened = iter(cameras)
    capture = SteppedCapture(steps, lambda _: next(opened), Backoff(0.01, 0.02))
    stream = VideoStream("0", tracker=CountingTracker(), capture=capture)
    assert [frame.index for frame in take(stream, 4)] == [0, 1, 2, 52]
    with pytest.raises(UserError, match="changed from 4 x 4 to 6 x 6 pixels"):
        take(stream, 1)
    assert stream.counts["another resolution"] == 99
    steps.release()
    stream.close()


def test_what_else_the_tracker_cannot_do_is_told_as_it_is():
    class NoModel(CountingTracker):
        def __call__(self, image_rgb: np.ndarray, index: int | None = None) -> TrackedFrame | None:
            raise UserError("No irises.", "Bring some.")

    steps = threading.Semaphore(1)
    capture = SteppedCapture(steps, lambda _: FakeCamera([lit(50)], steps))
    stream = VideoStream("0", tracker=NoModel(), capture=capture)
    with pytest.raises(UserError, match="No irises"):
        take(stream, 1)
    steps.release()
    stream.close()


def test_a_slow_tracker_gets_the_latest_frame():
    steps = threading.Semaphore(5)
    camera = FakeCamera([lit(10 + i) for i in range(20)], steps)
    capture = LatestFrameCapture("0", lambda _: camera)
    assert camera.waits.wait(DEADLINE_S)
    first = capture.next(1.0)
    camera.waits.clear()
    steps.release(5)
    assert camera.waits.wait(DEADLINE_S)
    second = capture.next(1.0)
    steps.release(20)
    capture.close()
    assert first is not None
    assert second is not None
    assert (first.index, second.index, capture.counts["skipped"]) == (4, 9, 8)
    assert int(second.image_rgb[0, 0, 0]) == 10 + second.index


@pytest.mark.slow
@pytest.mark.skipif(not REAL_CLIPS.exists(), reason=f"no clips at {REAL_CLIPS}")
def test_a_real_clip_becomes_a_stream_of_frames_with_a_face():
    pytest.importorskip("mediapipe", reason="mediapipe is not installed")
    stream = VideoStream(str(REAL_CLIPS / "grid_id2.mpg"), image_size=128)
    who = stream.subject(120.0)
    assert who is not None
    assert (who.width, who.height) == (128, 128)
    frames = take(stream, 16)
    stream.close()
    assert [frame.index for frame in frames] == list(range(16))
    for frame in frames:
        alpha = frame.decode().image_rgba[..., 3]
        assert 0.05 < (alpha > 128).mean() < 0.95
        assert bool(frame.theta.isfinite().all())
