"""Videos and images that cannot be read, or not whole: refused with a remedy, or read as far."""

import subprocess
import sys
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.io import wavfile

from rgbavatar_ns.data import png
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.input.image_files import read_image_rgba
from rgbavatar_ns.tracking.input.video import FrameSource

from .clips import gradient_images, write_clip


def test_what_cannot_be_read_is_the_users_error_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "empty.mp4").write_bytes(b"")
    for name, told in (("absent.mp4", "no video at"), ("empty.mp4", "0 bytes")):
        with pytest.raises(UserError, match=told):
            FrameSource.open(tmp_path / name)
    (tmp_path / "noise.mp4").write_bytes(b"this is no video" * 50)
    for folder in ("empty", "png", "jpg"):
        (tmp_path / folder).mkdir()
        if folder != "empty":
            (tmp_path / folder / f"a.{folder}").write_bytes(b"no picture")
    for name, told in (
        ("noise.mp4", "cannot be read"),
        ("empty", "holds no images"),
        ("png", "is not a PNG"),
        ("jpg", "cannot be decoded"),
    ):
        with pytest.raises(UserError, match=told):
            list(FrameSource.open(tmp_path / name))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".bmp", ".tiff", "png.jpg"])
def test_a_picture_that_was_cut_in_half_is_refused_by_name(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (96, 128, 3)).astype(np.uint8), (0, 0), 3)
    encoded = cv2.imencode(".png" if suffix == "png.jpg" else suffix, image)[1].tobytes()
    for number in range(3):
        (tmp_path / f"{number}{suffix}").write_bytes(encoded)
    assert len(list(FrameSource.open(tmp_path))) == 3
    (tmp_path / f"1{suffix}").write_bytes(encoded[: len(encoded) // 2])
    with pytest.raises(UserError, match=rf"1{suffix} .*(truncated|cannot be decoded)"):
        list(FrameSource.open(tmp_path))


def test_clips_of_two_sizes_are_refused(tmp_path: Path) -> None:
    a = write_clip(tmp_path / "a.mp4", gradient_images(2))
    b = write_clip(tmp_path / "b.mp4", gradient_images(2, 64, 80))
    with pytest.raises(UserError, match="one size"):
        list(FrameSource.open([a, b]))


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "webp", "tif"])
def test_an_image_of_more_pixels_than_are_read_is_refused_before_any_is_decoded(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"a.{suffix}"
    Image.new("RGB", (120, 90), (9, 99, 0)).save(path)
    assert read_image_rgba(path).shape == (90, 120, 4)
    monkeypatch.setattr(png, "MAX_PIXELS", 120 * 90 - 1)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it is decoded"))
    with pytest.raises(
        UserError, match=r"a\.\w+ is said to have 120 x 90 pixels\. Make it smaller"
    ):
        read_image_rgba(path)


def test_floating_point_images_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tiff"), np.zeros((8, 8, 3), np.float32))
    with pytest.raises(UserError, match="float32"):
        read_image_rgba(tmp_path / "a.tiff")


def test_images_of_two_sizes_are_refused_by_name(tmp_path: Path) -> None:
    for number, size in enumerate((8, 8, 9)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.zeros((size, 8, 3), np.uint8))
    with pytest.raises(UserError, match=r"2\.png has 8 x 9 pixels"):
        list(FrameSource.open(tmp_path))


def test_a_sound_file_has_no_video_even_with_a_cover(tmp_path: Path) -> None:
    sound = tmp_path / "sound.wav"
    wavfile.write(sound, 8000, np.zeros(8000, np.int16))
    song = tmp_path / "song.m4a"
    cover = cv2.imencode(".png", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    with av.open(str(sound)) as source, av.open(str(song), "w", format="mp4") as sink:
        out = sink.add_stream("aac", rate=8000)
        picture = sink.add_stream("png", rate=1)
        picture.width = picture.height = 16
        picture.pix_fmt = "rgb24"
        picture.disposition = av.stream.Disposition.attached_pic
        packet = av.Packet(cover)
        packet.stream = picture
        packet.pts = packet.dts = 0
        sink.mux(packet)
        for frame in (*source.decode(audio=0), None):
            sink.mux(out.encode(frame))
    for file in (sound, song):
        with pytest.raises(UserError, match="no video stream"):
            list(FrameSource.open(file))


def test_a_truncated_file_gives_its_readable_part_or_is_refused(tmp_path: Path) -> None:
    for name, readable in (("whole.mkv", True), ("whole.mp4", False)):
        whole = write_clip(tmp_path / name, gradient_images(12, 96, 128))
        cut = tmp_path / f"cut_{name}"
        cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
        if readable:
            assert 0 < len(list(FrameSource.open(cut))) < 12
        else:
            with pytest.raises(UserError, match="cannot be read as a video"):
                list(FrameSource.open(cut))


def test_damage_in_the_middle_costs_those_frames_and_is_noted(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (48, 64, 3)).astype(np.uint8) for _ in range(8)]
    clip = write_clip(tmp_path / "clip.avi", images, "png", "rgb24")
    data = bytearray(clip.read_bytes())
    places = [k for k in range(len(data) - 8) if data[k : k + 4] == b"\x89PNG"]
    data[places[3] : places[3] + 64] = bytes(64)
    clip.write_bytes(bytes(data))
    source = FrameSource.open(clip)
    frames = list(source)
    # A decoder with several threads may lose the frame that it worked on beside the damaged one.
    assert 6 <= len(frames) <= 7
    sent = [next(k for k in range(8) if (images[k] == one.image_rgb).all()) for one in frames]
    assert sent == sorted(set(sent) - {3})
    assert any("damaged" in note for note in source.notes)


_STOPPED_EARLY = """
import sys
import av, av.logging
from rgbavatar_ns.tracking.input.video import FrameSource
av.logging.set_level(av.logging.ERROR)  # As torchvision does when it is imported.
print([frame.index for frame in FrameSource.open(sys.argv[1]).these([1], 24)])
"""


def test_reading_that_stops_early_does_not_wait_for_a_thread_that_met_damage(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (1200, 1600, 3)).astype(np.uint8)
    clip = write_clip(tmp_path / "clip.avi", [image] * 8, "png", "rgb24")
    pictures = clip.read_bytes().split(b"IEND")
    # Near the end of its data a picture's damage is met long after the frame before was given.
    damaged = [one[:-60_000] + bytes(1000) + one[-59_000:] for one in pictures[2:8]]
    clip.write_bytes(b"IEND".join([*pictures[:2], *damaged, *pictures[8:]]))
    command = [sys.executable, "-c", _STOPPED_EARLY, str(clip)]
    told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert told.stdout == "[1]\n"
