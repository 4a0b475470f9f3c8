"""The driven avatar as film, raw frames and virtual camera."""

import os
import sys
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch

from rgbavatar_ns.driving.live_drive import DrivenFrame
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import front_camera, pictures
from rgbavatar_ns.export.live_pictures import FilmSink, PictureOutput, RawSink, VirtualCameraSink

from .subject import avatar_of, lively_theta

_WHITE = (1.0, 1.0, 1.0)


class _Kept:
    def __init__(self):
        self.pictures, self.times_s = [], []

    def add(self, picture, time_s):
        self.pictures.append(picture)
        self.times_s.append(time_s)

    def close(self):
        pass


def _frame(k, theta, image=None, rate=25.0):
    return DrivenFrame(k, theta, 0.0, k / rate, image)


def test_what_is_shown_is_the_avatars_picture():
    avatar = avatar_of()
    camera, theta = front_camera(avatar, 48, 40), lively_theta(avatar, 3)
    kept = _Kept()
    output = PictureOutput(avatar, camera, _WHITE, kept)
    for k, row in enumerate(theta):
        output.show(_frame(k, row))
    for drawn, wanted in zip(kept.pictures, pictures(avatar, theta, camera, _WHITE)):
        assert np.abs(drawn.astype(int) - wanted).max() <= 1, "to the eye: one of 255 levels"
    assert output.latencies.shown == 3


def test_the_performer_stands_beside_it_at_one_width_whatever_comes():
    avatar = avatar_of()
    kept = _Kept()
    output = PictureOutput(avatar, front_camera(avatar, 40, 40), _WHITE, kept, beside=True)
    theta = torch.zeros(avatar.layout.size)
    for k, size in enumerate([(40, 53), (40, 53), (40, 30), (40, 90)]):
        output.show(_frame(k, theta, np.full((*size, 3), 200, np.uint8)))
    assert {picture.shape for picture in kept.pictures} == {(40, 93, 3)}
    for picture, width in zip(kept.pictures, (53, 53, 30, 53)):
        assert (picture[:, :width] == 200).all()
        assert (picture[:, width:53] == 255).all()


def _levels(path):
    """The mean level of each of a film's frames."""
    with av.open(str(path)) as film:
        return [frame.to_ndarray(format="rgb24").mean() for frame in film.decode(video=0)]


def _grey(level):
    return np.full((16, 16, 3), level, np.uint8)


def test_a_film_keeps_the_performances_own_timing(tmp_path):
    sink = FilmSink(tmp_path / "film.mp4", 25.0)
    for time_s, level in [(3.00, 50), (3.04, 100), (3.20, 150), (3.205, 160), (3.24, 200)]:
        sink.add(_grey(level), time_s)
    sink.close()
    wanted = [50, 100, 100, 100, 100, 150, 200]
    assert np.allclose(_levels(tmp_path / "film.mp4"), wanted, atol=4)


def test_a_clock_that_jumps_makes_no_endless_film(tmp_path):
    sink = FilmSink(tmp_path / "film.mp4", 25.0)
    for time_s in (0.0, 0.04, 9e9, 9e9 + 0.04, 5.0):
        sink.add(_grey(80), time_s)
    sink.close()
    assert len(_levels(tmp_path / "film.mp4")) == 5


def test_a_long_pause_stands_still_for_ten_seconds_and_the_film_goes_on(tmp_path):
    for pause_s, repeats in ((9.0, 225), (10.0, 250), (11.0, 251), (600.0, 251)):
        sink = FilmSink(tmp_path / "film.mp4", 25.0)
        for time_s, level in [(3.0, 50), (3.0 + pause_s, 150), (3.04 + pause_s, 200)]:
            sink.add(_grey(level), time_s)
        sink.close()
        wanted = [50] * repeats + [150, 200]
        assert np.allclose(_levels(tmp_path / "film.mp4"), wanted, atol=4)


def test_at_any_rate_a_pause_stands_still_for_as_long(tmp_path):
    for rate in (10.0, 60.0):
        sink = FilmSink(tmp_path / "film.mp4", rate)
        for time_s, level in [(3.0, 50), (33.0, 150), (33.0 + 1 / rate, 200)]:
            sink.add(_grey(level), time_s)
        sink.close()
        assert len(_levels(tmp_path / "film.mp4")) == 10 * rate + 3


def test_without_a_picture_there_is_no_film(tmp_path):
    sink = FilmSink(tmp_path / "film.mp4", 25.0)
    with pytest.raises(UserError, match="has no picture"):
        sink.close()
    assert list(tmp_path.iterdir()) == []


def test_raw_frames_are_their_bytes_one_after_the_other():
    read, write = os.pipe()
    sink = RawSink(write)
    first, second = (np.random.default_rng(k).integers(256, size=(4, 6, 3)) for k in (0, 1))
    for picture in (first, second):
        sink.add(picture.astype(np.uint8), 0.0)
    os.close(write)
    content = os.read(read, 10_000)
    os.close(read)
    assert content == first.astype(np.uint8).tobytes() + second.astype(np.uint8).tobytes()


def test_a_virtual_camera_gets_the_pictures(monkeypatch, tmp_path):
    sent = []

    class Camera:
        def __init__(self, width, height, rate, device):
            sent.append((width, height, rate, device))

        def send(self, picture):
            sent.append(picture.shape)

        def close(self):
            sent.append("closed")

    monkeypatch.setitem(sys.modules, "pyvirtualcam", SimpleNamespace(Camera=Camera))
    device = tmp_path / "video10"
    with pytest.raises(UserError, match=r"no device.*modprobe v4l2loopback"):
        VirtualCameraSink(str(device), 25.0)
    device.write_text("")
    sink = VirtualCameraSink(str(device), 25.0)
    sink.add(_grey(1), 0.0)
    sink.close()
    assert sent == [(16, 16, 25.0, str(device)), (16, 16, 3), "closed"]


def test_what_a_virtual_camera_lacks_is_told(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyvirtualcam", None)
    with pytest.raises(UserError, match="pip install pyvirtualcam"):
        VirtualCameraSink("/dev/video10", 25.0)

    def refuse(*_, **__):
        raise RuntimeError("not a video output device")

    monkeypatch.setitem(sys.modules, "pyvirtualcam", SimpleNamespace(Camera=refuse))
    (tmp_path / "video10").write_text("")
    sink = VirtualCameraSink(str(tmp_path / "video10"), 25.0)
    with pytest.raises(UserError, match="takes no pictures: not a video"):
        sink.add(_grey(1), 0.0)
