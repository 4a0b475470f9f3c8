"""Bars around a film are no part of it: with them it is the same film."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import UInt8

from rgbavatar_ns.files import read_json
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.input.bars import NO_BARS, Bars, find_bars
from rgbavatar_ns.tracking.input.mattes import UserMattes, given_mattes
from rgbavatar_ns.tracking.input.video import FrameSource

from .clips import astronaut, write_clip

_Picture = UInt8[np.ndarray, "h w 3"]
_BARS = [Bars(0, 30, 0, 30), Bars(21, 0, 22, 0), Bars(12, 40, 12, 40)]


def _pictures(count: int = 4, height: int = 96, width: int = 128) -> list[_Picture]:
    generator = np.random.default_rng(0)
    return list(generator.integers(0, 256, (count, height, width, 3), dtype=np.uint8))


def _framed(picture: np.ndarray, bars: Bars, level: int = 0) -> np.ndarray:
    sides = ((bars.top, bars.bottom), (bars.left, bars.right), (0, 0))[: picture.ndim]
    return np.pad(picture, sides, constant_values=level)


def _folder(path: Path, pictures: list[np.ndarray]) -> Path:
    path.mkdir()
    for number, picture in enumerate(pictures):
        shown = picture[..., ::-1] if picture.ndim == 3 else picture
        cv2.imwrite(str(path / f"{number:05d}.png"), shown)
    return path


@pytest.mark.parametrize("level", [0, 128, 255])
@pytest.mark.parametrize("bars", [NO_BARS, *_BARS])
def test_bars_are_found_to_the_pixel(bars: Bars, level: int) -> None:
    assert find_bars(_framed(one, bars, level) for one in _pictures()) == bars


def test_a_fade_from_black_and_what_compression_does_change_nothing() -> None:
    bars = _BARS[0]
    black = np.zeros((156, 128, 3), np.uint8)
    generator = np.random.default_rng(1)
    noisy = [
        np.clip(_framed(one, bars, 16) + generator.integers(-3, 4, (156, 128, 3)), 0, 255)
        for one in _pictures()
    ]
    assert find_bars([black, *(one.astype(np.uint8) for one in noisy), black]) == bars


def _person_before_a_wall() -> _Picture:
    picture = np.full((200, 160, 3), 255, np.uint8)
    cv2.circle(picture, (80, 90), 50, (120, 150, 200), -1)
    cv2.ellipse(picture, (80, 230), (78, 90), 0, 0, 360, (40, 40, 60), -1)
    return picture


def _with_a_ceiling() -> _Picture:
    picture = _pictures(1)[0]
    picture[:20] = 200
    return picture


def _cut_out() -> UInt8[np.ndarray, "h w 4"]:
    picture = np.zeros((200, 160, 4), np.uint8)
    picture[60:140] = 200
    return picture


@pytest.mark.parametrize("picture", [_person_before_a_wall(), _with_a_ceiling(), _cut_out()])
def test_what_is_even_without_being_a_bar_stays(picture: np.ndarray) -> None:
    assert find_bars([picture] * 3) == NO_BARS


def test_nor_has_a_film_of_nothing_bars() -> None:
    assert find_bars([]) == NO_BARS
    assert find_bars([np.zeros((90, 90, 3), np.uint8)]) == NO_BARS
    assert find_bars([_framed(one, _BARS[0]) for one in _pictures(2, 20)]) == NO_BARS
    several = [_framed(_pictures(1)[0], bars) for bars in _BARS]
    assert find_bars(several) == NO_BARS


@pytest.mark.parametrize("bars", _BARS)
@pytest.mark.parametrize("max_side", [None, 40])
def test_a_source_reads_the_same_frames(tmp_path: Path, bars: Bars, max_side: int | None) -> None:
    pictures = _pictures()
    plain = FrameSource.open(_folder(tmp_path / "plain", list(pictures)))
    framed = FrameSource.open(_folder(tmp_path / "framed", [_framed(p, bars) for p in pictures]))
    found = framed.without_bars()
    assert found.bars == bars
    assert plain.without_bars().bars == NO_BARS
    for one, other in zip(plain.read(max_side=max_side), found.read(max_side=max_side)):
        assert (one.width, one.height) == (other.width, other.height)
        np.testing.assert_array_equal(one.image_rgb, other.image_rgb)
    assert sum(1 for _ in framed) == 4
    assert next(iter(framed)).height == 96 + bars.top + bars.bottom, "not asked to"


@pytest.mark.filterwarnings("error")
def test_two_even_fields_are_no_bars() -> None:
    picture = np.full((90, 120, 3), 40, np.uint8)
    picture[:, 60:] = 200
    assert find_bars([picture, picture.swapaxes(0, 1)]) == NO_BARS
    assert find_bars([picture] * 2) == NO_BARS


def test_images_that_nobody_reads_are_not_looked_at(tmp_path: Path) -> None:
    film = _folder(tmp_path / "film", [_framed(one, _BARS[0]) for one in _pictures()])
    (film / "00003.png").write_bytes(b"no image")
    assert FrameSource.open(film, max_frames=3).without_bars().bars == _BARS[0]


def test_bars_of_a_video(tmp_path: Path) -> None:
    picture = astronaut()[::2, ::2]
    bars = Bars(0, 40, 0, 40)
    frames = [_framed(np.roll(picture, k, axis=1), bars) for k in range(30)]
    clip = write_clip(tmp_path / "clip.mp4", frames)
    assert FrameSource.open(clip).without_bars().bars == bars
    assert FrameSource.open([clip, clip]).without_bars().bars == bars


def test_mattes_of_the_whole_picture_are_cut_alike(tmp_path: Path) -> None:
    bars, pictures = _BARS[2], _pictures()
    mattes = [one[..., 0] for one in _pictures(4)]
    film = _folder(tmp_path / "film", [_framed(p, bars) for p in pictures])
    given = _folder(tmp_path / "mattes", [_framed(m, bars) for m in mattes])
    source = FrameSource.open(film).without_bars()
    wanted = frozenset(range(4))
    found = given_mattes(source, wanted, UserMattes.open(given, source), source_alpha=False)
    for matte, (_, level) in zip(mattes, found):
        np.testing.assert_array_equal(level, matte)


def test_the_dataset_is_that_of_the_film_without_them(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
    from rgbavatar_ns.tracking import track_video

    image = astronaut()
    config = TrackConfig(image_size=64, key_frames=1, focal_px=500.0)
    written = {}
    for name, bars in (("plain", NO_BARS), ("framed", Bars(0, 90, 0, 90))):
        film = _folder(tmp_path / name, [_framed(np.roll(image, k, 1), bars) for k in range(3)])
        track_video(film, tmp_path / f"{name}_set", config)
        files = sorted((tmp_path / f"{name}_set").rglob("*.*"))
        written[name] = {
            str(path.relative_to(tmp_path / f"{name}_set")): path.read_bytes()
            for path in files
            if path.name != "tracking.json"
        }
    assert written["plain"] == written["framed"]
    notes = read_json(tmp_path / "framed_set" / "tracking.json")["notes"]
    assert notes == ["bars around the film are cut off: 90 pixels above, 90 pixels below"]
