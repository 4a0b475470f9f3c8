"""Cameras and videos as performances, with a tracker of the tests' own and with the real one."""

import time
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rgbavatar_ns.data.streams.address import told_address
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import write_video
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.input import capture as capture_module
from rgbavatar_ns.tracking.input.capture import (
    CapturedFrame,
    FileCapture,
    LatestFrameCapture,
    is_device,
)
from rgbavatar_ns.tracking.performer import FilmedPerformer


class _Tracker:
    """Theta is the picture's mean level; the first `warm_up` pictures give the person."""

    def __init__(self, warm_up=3, seconds=0.0):
        self.head = HeadModel.embedded()
        self.counts = Counter()
        self.closed = 0
        self._warm_up, self._seconds, self._kept = warm_up, seconds, []
        self.ready = False

    def pose(self, image_rgb, index=0):
        if self.ready:
            return self._theta(image_rgb)
        self._kept.append((index, self._theta(image_rgb)))
        if len(self._kept) == self._warm_up:
            time.sleep(self._seconds)
            self.ready = True
        return None

    def _theta(self, image_rgb):
        return torch.full((self.head.layout.size,), float(image_rgb.mean()))

    def pose_backlog(self):
        kept, self._kept = self._kept, []
        return kept

    def close(self):
        self.closed += 1


@pytest.fixture
def film(tmp_path):
    """Forty frames at 25 a second, each brighter than the one before."""
    path = tmp_path / "film.mp4"
    write_video(path, (np.full((32, 32, 3), 40 + 5 * k, np.uint8) for k in range(40)), 25.0)
    return path


def _all(performer):
    frames = []
    while not performer.ended:
        frame = performer.next(0.2)
        if frame is not None:
            frames.append(frame)
    return frames


def test_offline_no_frame_is_lost_not_even_those_that_give_the_person(film):
    performer = FilmedPerformer(str(film), False, image_height_px=8, tracker=_Tracker(warm_up=12))
    frames = _all(performer)
    assert [frame.index for frame in frames] == list(range(40))
    levels = [float(frame.theta[0]) for frame in frames]
    assert np.allclose(levels, [40 + 5 * k for k in range(40)], atol=3)
    assert [frame.image_rgb.shape for frame in frames] == [(8, 8, 3)] * 40
    shown = [frame.image_rgb.mean() for frame in frames]
    assert np.allclose(shown, levels, atol=1), "of that frame, and tracked at its own size"
    assert frames[25].time_s - frames[0].time_s == pytest.approx(1.0)


def test_in_real_time_what_is_late_is_skipped_and_lateness_is_honest(film):
    performer = FilmedPerformer(str(film), True, tracker=_Tracker(warm_up=3, seconds=0.5))
    began_s, frames, late_s = time.monotonic(), [], []
    while not performer.ended:
        frame = performer.next(0.2)
        if frame is not None:
            frames.append(frame)
            late_s.append(time.monotonic() - frame.captured_s)
    assert 1.3 < time.monotonic() - began_s < 3.0
    assert 8 <= performer.counts["skipped"] <= 20
    assert np.median(late_s) < 0.06
    assert frames[0].index >= 10


def test_pictures_without_a_face_are_not_kept_until_one_comes(film):
    tracker = _Tracker()

    def nobody(image_rgb, index=0):
        tracker.counts["no face"] += 1

    tracker.pose = nobody  # type: ignore[method-assign]
    performer = FilmedPerformer(str(film), False, tracker=tracker)
    assert _all(performer) == []
    assert performer.counts["no face"] == 40
    assert performer._unmet == {}


def test_closing_twice_closes_once(film):
    tracker = _Tracker()
    performer = FilmedPerformer(str(film), False, tracker=tracker)
    performer.close()
    performer.close()
    assert tracker.closed == 1
    assert performer.ended


def test_a_camera_that_is_not_there_is_told_at_once():
    began_s = time.monotonic()
    with pytest.raises(UserError, match=r"Camera 77 cannot be opened: it is not there, or another"):
        FilmedPerformer("77", tracker=_Tracker())
    assert time.monotonic() - began_s < 10


def test_a_camera_that_shows_nothing_is_told(monkeypatch):
    closed = SimpleNamespace(isOpened=lambda: False, release=lambda: None)
    silent = LatestFrameCapture("0", opener=lambda source: closed)
    performer = FilmedPerformer("0", tracker=_Tracker(), capture=silent)
    assert performer.next(0.1) is None
    assert "first picture of 0" in performer.waits_for
    monkeypatch.setattr("rgbavatar_ns.tracking.performer._FIRST_PICTURE_S", 0.0)
    with pytest.raises(UserError, match="0 has shown no picture for"):
        performer.next(0.1)
    performer.close()


def test_a_camera_that_is_pulled_out_is_told_and_not_the_person(monkeypatch):
    picture = CapturedFrame(0, np.zeros((4, 6, 3), np.uint8), 0.0)

    class Camera(LatestFrameCapture):
        def next(self, timeout_s):
            return frames.pop() if frames else None

    frames = [picture, picture]
    closed = SimpleNamespace(isOpened=lambda: False, release=lambda: None)
    camera = Camera("0", opener=lambda source: closed)
    performer = FilmedPerformer("0", tracker=_Tracker(warm_up=9), capture=camera)
    assert performer.next(0.1) is None
    assert "look at the camera" in performer.waits_for
    monkeypatch.setattr("rgbavatar_ns.tracking.performer._SILENT_S", -1.0)
    assert "pictures of 0 to come again: is it still connected?" in performer.waits_for
    monkeypatch.undo()
    performer.next(0.1)
    assert "look at the camera" in performer.waits_for
    performer.close()


def test_a_cameras_password_is_told_to_nobody(monkeypatch):
    source = "rtsp://admin:secret@cam:554/1?token=secret"
    closed = SimpleNamespace(isOpened=lambda: False, release=lambda: None)
    silent = LatestFrameCapture(source, opener=lambda source: closed)
    performer = FilmedPerformer(source, tracker=_Tracker(), capture=silent)
    told = [performer.waits_for]
    for performer._shown_s in (time.monotonic(), 0.0, None):
        told.append(performer.waits_for)
    monkeypatch.setattr("rgbavatar_ns.tracking.performer._FIRST_PICTURE_S", 0.0)
    with pytest.raises(UserError) as silence:
        performer.next(0.1)
    performer.close()
    # A port of this machine at which nothing answers.
    with pytest.raises(UserError) as refused:
        FilmedPerformer(source.replace("cam:554", "127.0.0.1:9"), tracker=_Tracker())
    told += [str(silence.value), str(refused.value)]
    assert all("rtsp://cam:554/1" in line for line in told[:5])
    assert "rtsp://127.0.0.1:9/1 cannot be opened: nothing answers there" in told[5]
    for remedy in (silence.value.remedy, refused.value.remedy):
        assert "host, port and path, and at user and password" in remedy
        assert "--source NUMBER" not in remedy, "which is of cameras of this machine"
    assert not any("secret" in line or "admin" in line for line in told)


@pytest.mark.parametrize(
    ("address", "told"),
    [
        ("rtsp://cam/1", "rtsp://cam/1"),
        ("rtsp://a:b@[::1]:554/1", "rtsp://[::1]:554/1"),
        ("rtsp://a:p@/ss@cam/1", "rtsp://cam/1"),
        ("rtsp://a:p?ss@cam/1", "rtsp://..."),
        ("http://cam/v.mjpg?user=a&pwd=b", "http://cam/v.mjpg"),
        ("rtsp://cam/user=a&password=b.sdp", "rtsp://cam/..."),
        ("me@home.mp4", "me@home.mp4"),
        ("0", "0"),
    ],
)
def test_an_address_is_told_without_what_opens_it(address, told):
    assert told_address(address) == told


def test_a_camera_that_comes_back_with_another_size_is_told():
    shown = [np.zeros((4, 6, 3), np.uint8), *[np.zeros((8, 8, 3), np.uint8)] * 50]
    frames = (CapturedFrame(k, image, 0.0) for k, image in enumerate(shown))

    class Camera(LatestFrameCapture):
        def next(self, timeout_s):
            return next(frames)

    closed = SimpleNamespace(isOpened=lambda: False, release=lambda: None)
    camera = Camera("0", opener=lambda source: closed)
    performer = FilmedPerformer("0", tracker=_Tracker(), capture=camera)
    assert [performer.next(0.1) for _ in range(50)] == [None] * 50
    with pytest.raises(UserError, match="changed from 6 x 4 to 8 x 8 pixels"):
        performer.next(0.1)
    assert performer.counts["another resolution"] == 50
    performer.close()


def test_a_folder_of_images_may_be_named_by_a_number(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert [is_device(name) for name in ("0", "2024", "/dev/video0", "me.mp4")] == [
        *[True] * 3,
        False,
    ]
    (tmp_path / "2024").mkdir()
    assert not is_device("2024")


def test_what_is_waited_for_changes_with_what_is_known(film):
    tracker = _Tracker(warm_up=2)
    performer = FilmedPerformer(str(film), False, tracker=tracker)
    performer.next(0.1)
    assert performer.waits_for == f"a face in {film} to be met: a dozen give the person"
    _all(performer)
    assert performer.waits_for.endswith("found again: pictures without one are passed over")


def test_a_missing_video_is_told(tmp_path):
    with pytest.raises(UserError, match="There is no video"):
        FilmedPerformer(str(tmp_path / "none.mp4"), tracker=_Tracker())


def test_a_film_that_is_read_more_slowly_than_it_plays_is_shown_all_along(film, monkeypatch):
    read = FileCapture._read

    def slowly(self):
        time.sleep(0.06)  # of frames of .04
        return read(self)

    monkeypatch.setattr(FileCapture, "_read", slowly)
    capture, shown = FileCapture(film, "newest"), []
    while not capture.ended:
        if (frame := capture.next(1.0)) is not None:
            shown.append(frame.index)
    assert shown == sorted(shown)
    assert len(shown) > 8
    assert shown[-1] == 39


def test_the_newest_due_frame_of_a_file_ends_with_its_last(film, monkeypatch):
    monkeypatch.setattr(capture_module, "_LONGEST_SKIP_S", 60.0)
    capture = FileCapture(film, "newest")
    time.sleep(0)
    first = capture.next(1.0)
    time.sleep(3.0)
    last = capture.next(1.0)
    assert isinstance(last, CapturedFrame)
    assert (first.index, last.index) == (0, 39)
    assert capture.ended
    assert capture.counts["skipped"] == 38
    assert capture.next(0.1) is None
