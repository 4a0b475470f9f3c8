"""Every kind of file that a user may bring: read rightly, or refused in words."""

import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from rgbavatar_ns.tracking.input import video
from rgbavatar_ns.tracking.input.image_files import image_files, read_image_rgba
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.threads import InBackground

from .clips import gradient_images, write_clip


def test_frames_come_in_order_and_the_same_on_every_reading(tmp_path: Path) -> None:
    images = gradient_images(6)
    clip = write_clip(tmp_path / "Größe — 影.mp4", images)
    source = FrameSource.open(clip)
    first = list(source)
    assert [frame.index for frame in first] == list(range(6))
    for frame, image in zip(first, images):
        assert np.abs(frame.image_rgb.astype(int) - image).mean() < 6
    for frame, again in zip(first, source):
        np.testing.assert_array_equal(frame.image_rgb, again.image_rgb)


def test_a_name_with_a_colon_is_no_network_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_clip(tmp_path / "clip.mkv", gradient_images(3)).rename(tmp_path / "2026-11-27T10:30.mkv")
    monkeypatch.chdir(tmp_path)
    source = FrameSource.open("2026-11-27T10:30.mkv")
    assert source.count_hint() in (3, None)
    assert len(list(source)) == 3


def test_clips_are_concatenated_and_numbered(tmp_path: Path) -> None:
    a = write_clip(tmp_path / "a.mp4", gradient_images(3))
    b = write_clip(tmp_path / "b.mkv", gradient_images(4))
    frames = list(FrameSource.open([a, b]))
    assert [frame.index for frame in frames] == list(range(7))
    assert [frame.clip for frame in frames] == [0, 0, 0, 1, 1, 1, 1]
    assert len(list(FrameSource.open([a, b], max_frames=5))) == 5


def test_an_image_folder_is_a_clip(tmp_path: Path) -> None:
    for number, image in enumerate(gradient_images(3)):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), image[..., ::-1])
    frames = list(FrameSource.open(tmp_path))
    for frame, image in zip(frames, gradient_images(3)):
        np.testing.assert_array_equal(frame.image_rgb, image)
    assert len(frames) == 3


def test_nothing_is_decoded_behind_the_last_frame_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = FrameSource.open(write_clip(tmp_path / "clip.mp4", gradient_images(9)))
    passed: list[int] = []
    read = source.read

    def counted(wanted, max_side=None):
        return read(lambda index: passed.append(index) or wanted(index), max_side)

    monkeypatch.setattr(FrameSource, "read", lambda self, *given: counted(*given))
    assert [frame.index for frame in source.these({1, 4})] == [1, 4]
    assert passed == [0, 1, 2, 3, 4]
    assert list(source.these([])) == []


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_rotation_metadata_is_honoured(tmp_path: Path, degrees: int) -> None:
    turned = write_clip(tmp_path / "turned.mp4", gradient_images(2))
    cos, sin = {90: (0, 1), 180: (-1, 0), 270: (0, -1)}[degrees]
    _patch_display_matrix(turned, cos, sin, -sin, cos)
    upright = next(iter(FrameSource.open(turned))).image_rgb
    with av.open(str(turned)) as container:
        frame = next(container.decode(video=0))
        stored, rotation = frame.to_ndarray(format="rgb24"), frame.rotation
    assert rotation % 360 != 0
    # The container's matrix turns the stored picture clockwise by `degrees`.
    np.testing.assert_array_equal(upright, np.rot90(stored, -degrees // 90))


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((-1, 0, 0, 1), np.fliplr),
        ((1, 0, 0, -1), np.flipud),
        ((0, 1, 1, 0), lambda image: image.transpose(1, 0, 2)),
        ((0, -1, -1, 0), lambda image: np.rot90(image, 2).transpose(1, 0, 2)),
    ],
)
def test_a_film_that_is_to_be_shown_mirrored_is(
    tmp_path: Path, matrix: tuple[int, int, int, int], shown: Callable[[np.ndarray], np.ndarray]
) -> None:
    images = gradient_images(2)
    for image in images:
        image[:20] //= 3
    clip = write_clip(tmp_path / "mirrored.mp4", images)
    stored = next(iter(FrameSource.open(clip))).image_rgb
    _patch_display_matrix(clip, *matrix)
    frame = next(iter(FrameSource.open(clip)))
    np.testing.assert_array_equal(frame.image_rgb, shown(stored))
    assert (frame.height, frame.width) == frame.image_rgb.shape[:2]


def test_a_film_with_side_data_that_pyav_cannot_name_is_turned_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unnamed(frame: av.VideoFrame) -> None:
        raise ValueError("32 is not a valid Type")

    clip = write_clip(tmp_path / "turned.mp4", gradient_images(2))
    _patch_display_matrix(clip, 0, 1, -1, 0)
    turned = next(iter(FrameSource.open(clip))).image_rgb
    monkeypatch.setattr(video, "SideDataContainer", unnamed)
    np.testing.assert_array_equal(next(iter(FrameSource.open(clip))).image_rgb, turned)
    assert turned.shape == (64, 48, 3)


def _patch_display_matrix(path: Path, a: int, b: int, c: int, d: int) -> None:
    """Write (x, y) -> (a x + c y, b x + d y) into the mp4 track header (ISO 14496-12, tkhd)."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4
    assert data[start] == 0
    values = (a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, start + 40, *values)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("codec", "pixel_format", "suffix"),
    [
        ("ffv1", "yuv420p10le", "mkv"),
        ("ffv1", "yuv444p", "mkv"),
        ("ffv1", "gray", "mkv"),
        ("mjpeg", "yuvj420p", "avi"),
        ("libx264", "yuv420p", "mp4"),
    ],
)
def test_codecs_depths_and_ranges_give_the_same_pictures(
    tmp_path: Path, codec: str, pixel_format: str, suffix: str
) -> None:
    images = gradient_images(4)
    clip = write_clip(tmp_path / f"clip.{suffix}", images, codec, pixel_format)
    for frame, image in zip(FrameSource.open(clip), images, strict=True):
        assert frame.image_rgb.dtype == np.uint8
        assert np.abs(frame.image_rgb[:, 8:24].astype(int) - image[:, 8:24]).max() <= 4


def test_odd_sizes_keep_every_pixel(tmp_path: Path) -> None:
    images = gradient_images(2, 47, 61)
    clip = write_clip(tmp_path / "odd.mkv", images, "ffv1", "yuv444p")
    frames = list(FrameSource.open(clip))
    assert frames[0].image_rgb.shape == (47, 61, 3)
    assert (frames[0].width, frames[0].height) == (61, 47)
    assert np.abs(frames[1].image_rgb.astype(int) - images[1])[:, 40:].max() <= 4


def test_a_variable_frame_rate_neither_doubles_nor_drops_frames(tmp_path: Path) -> None:
    times = [0, 40, 80, 400, 410, 900]
    clip = write_clip(tmp_path / "vfr.mkv", gradient_images(6), "ffv1", times_ms=times)
    frames = list(FrameSource.open(clip))
    assert [frame.time_s for frame in frames] == pytest.approx([t / 1000 for t in times], abs=2e-3)
    levels = [int(frame.image_rgb[..., 0].max()) for frame in frames]
    assert levels == sorted(set(levels))


def test_pixels_that_are_not_square_become_square(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "wide.mp4", gradient_images(2), pixel_aspect=Fraction(3, 2))
    frame = next(iter(FrameSource.open(clip)))
    assert frame.image_rgb.shape == (48, 96, 3)
    assert (frame.width, frame.height) == (96, 48)
    # The dark half still ends in the middle.
    assert frame.image_rgb[:, 44].mean() < 30 < 35 < frame.image_rgb[:, 52].mean()


def test_a_smaller_reading_knows_the_whole_size(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "clip.mkv", gradient_images(3, 96, 128), "ffv1")
    frame = next(FrameSource.open(clip).read(max_side=64))
    assert frame.image_rgb.shape == (48, 64, 3)
    assert (frame.width, frame.height) == (128, 96)


def test_only_wanted_frames_are_given_and_keep_their_numbers(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "clip.mkv", gradient_images(5), "ffv1")
    whole = list(FrameSource.open(clip))
    some = list(FrameSource.open(clip).read(lambda index: index in (1, 4)))
    assert [frame.index for frame in some] == [1, 4]
    np.testing.assert_array_equal(some[1].image_rgb, whole[4].image_rgb)


def test_folders_of_grey_sixteen_bit_and_alpha_images(tmp_path: Path) -> None:
    grey = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) * 20
    rgba = np.zeros((48, 64, 4), np.uint8)
    rgba[..., :3] = (10, 20, 200)
    rgba[:, 32:, 3] = 255
    cv2.imwrite(str(tmp_path / "1.png"), (grey >> 8).astype(np.uint8))
    cv2.imwrite(str(tmp_path / "2.png"), grey)
    cv2.imwrite(str(tmp_path / "3.tiff"), grey)
    cv2.imwrite(str(tmp_path / "4.png"), rgba)
    cv2.imwrite(str(tmp_path / "5.webp"), rgba, [cv2.IMWRITE_WEBP_QUALITY, 101])
    first, second, third, fourth, fifth = FrameSource.open(tmp_path)
    np.testing.assert_array_equal(first.image_rgb[..., 1], grey >> 8)
    for deep in (second, third):
        assert np.abs(deep.image_rgb[..., 2] - grey / 257).max() <= 0.5
        assert deep.alpha is None
    for clear in (fourth, fifth):
        assert tuple(clear.image_rgb[0, -1]) == (200, 20, 10)
        assert clear.alpha is not None
        np.testing.assert_array_equal(clear.alpha, rgba[..., 3])


def test_a_videos_alpha_channel_is_read(tmp_path: Path) -> None:
    rgba = np.full((48, 64, 4), 120, np.uint8)
    rgba[:, :20, 3] = 0
    clip = write_clip(tmp_path / "clear.mov", [rgba] * 2, "png", "rgba")
    for frame in FrameSource.open(clip):
        assert frame.alpha is not None
        np.testing.assert_array_equal(frame.alpha, rgba[..., 3])


@pytest.mark.parametrize("codec", ["libvpx", "libvpx-vp9"])
def test_a_transparent_webm_keeps_its_alpha_or_its_loss_is_noted(
    tmp_path: Path, codec: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rgba = np.full((48, 64, 4), 120, np.uint8)
    rgba[:, :32, 3] = 0
    with av.open(str(tmp_path / "clear.webm"), "w") as container:
        stream = container.add_stream(codec, rate=25, options={"auto-alt-ref": "0"})
        stream.height, stream.width, stream.pix_fmt = 48, 64, "yuva420p"
        frame = av.VideoFrame.from_ndarray(rgba, format="rgba")
        for packet in (*stream.encode(frame), *stream.encode(frame), *stream.encode()):
            container.mux(packet)
    source = FrameSource.open(tmp_path / "clear.webm")
    frames = list(source)
    assert [frame.time_s for frame in frames] == [0.0, 0.04]
    for frame in frames:
        assert frame.alpha is not None
        assert np.abs(frame.alpha.astype(int) - rgba[..., 3])[:, np.r_[:24, 40:64]].max() <= 4
    assert source.notes == []
    monkeypatch.setattr(
        video, "_ALPHA_DECODERS", {"vp8": "no_such_decoder", "vp9": "no_such_decoder"}
    )
    assert [frame.alpha for frame in source] == [None, None]
    assert ["alpha channel cannot be read" in note for note in source.notes] == [True]


def test_photographs_are_turned_as_their_exif_data_asks(tmp_path: Path) -> None:
    image = gradient_images(1)[0]
    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    # An EXIF block with nothing but orientation 6: turn clockwise by 90 degrees.
    tiff = b"MM\0*\0\0\0\x08" + b"\0\x01" + b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0" + b"\0\0\0\0"
    block = b"Exif\0\0" + tiff
    marker = b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block
    path = tmp_path / "phone.jpg"
    path.write_bytes(encoded[:2] + marker + encoded[2:])
    turned = read_image_rgba(path)[..., :3]
    assert turned.shape == (64, 48, 3)
    assert np.abs(turned.astype(int) - np.rot90(image, -1)).max() <= 4


def test_a_folders_other_files_are_passed_over_and_numbers_are_counted_as_numbers(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "Büro — кадры 影"
    folder.mkdir()
    for number in (10, 9, 2, 1):
        picture = cv2.imencode(".png", np.full((4, 4, 3), number, np.uint8))[1]
        picture.tofile(folder / f"Bild_ü{number}.png")
    for name in ("notes.txt", ".hidden.png", "Thumbs.db"):
        (folder / name).write_bytes(b"else")
    (folder / "deeper").mkdir()
    named = [f"Bild_ü{number}.png" for number in (1, 2, 9, 10)]
    assert [path.name for path in image_files(folder)] == named
    assert [int(frame.image_rgb.max()) for frame in FrameSource.open(folder)] == [1, 2, 9, 10]


_MEMORY = """
import resource, sys
from rgbavatar_ns.tracking.threads import InBackground
from rgbavatar_ns.tracking.input.video import FrameSource
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
for frame in InBackground(FrameSource.open(sys.argv[1]), 2):
    early = peak() if frame.index <= 8 else early
print(frame.index, *frame.image_rgb.shape, peak() - early)
"""


def test_memory_does_not_grow_with_the_length_of_a_4k_clip(tmp_path: Path) -> None:
    image = cv2.resize(gradient_images(1)[0], (3840, 2160))
    clip = write_clip(tmp_path / "large.mp4", [image] * 21)
    command = [sys.executable, "-c", _MEMORY, str(clip)]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert told[:4] == ["20", "2160", "3840", "3"]
    assert float(told[4]) < 60, "12 frames more would take 285 MiB"


def test_digits_that_are_no_decimal_numbers_are_letters_of_a_name(tmp_path: Path) -> None:
    for name in ("②", "a²10", "a²9", "①"):
        cv2.imencode(".png", gradient_images(1)[0])[1].tofile(tmp_path / f"{name}.png")
    assert [path.stem for path in image_files(tmp_path)] == ["a²9", "a²10", "①", "②"]


def test_closing_from_another_thread_ends_it_while_it_waits_for_a_slow_reader() -> None:
    asked, answered = threading.Event(), threading.Event()

    def slow() -> Iterator[int]:
        yield 0
        asked.set()
        answered.wait(20)
        yield 1

    inner = InBackground(slow(), 1)
    outer = InBackground((item for item in inner), 1)
    assert next(outer) == 0
    assert asked.wait(10)
    closing = threading.Thread(target=inner.close)
    closing.start()  # Its consumer is another thread, which is waiting in it.
    assert list(outer) == []
    answered.set()
    closing.join()
