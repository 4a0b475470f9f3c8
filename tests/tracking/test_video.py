from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.input.video import FrameSource

from .clips import gradient_images, write_clip


def test_frames_come_in_order_and_the_same_on_every_reading(tmp_path: Path) -> None:
    images = gradient_images(6)
    clip = write_clip(tmp_path / "clip.mp4", images)
    source = FrameSource.open(clip)
    first = list(source)
    assert [frame.index for frame in first] == list(range(6))
    for frame, image in zip(first, images):
        assert np.abs(frame.image_rgb.astype(int) - image).mean() < 6
    for frame, again in zip(first, source):
        np.testing.assert_array_equal(frame.image_rgb, again.image_rgb)


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


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_rotation_metadata_is_honoured(tmp_path: Path, degrees: int) -> None:
    import av

    plain = write_clip(tmp_path / "plain.mp4", gradient_images(2))
    turned = tmp_path / "turned.mp4"
    with av.open(str(plain)) as source, av.open(str(turned), "w") as sink:
        stream = source.streams.video[0]
        out = sink.add_stream_from_template(stream)
        for packet in source.demux(stream):
            if packet.dts is not None:
                packet.stream = out
                sink.mux(packet)
    _patch_display_matrix(turned, degrees)
    upright = next(iter(FrameSource.open(turned))).image_rgb
    with av.open(str(turned)) as container:
        frame = next(container.decode(video=0))
        stored, rotation = frame.to_ndarray(format="rgb24"), frame.rotation
    assert rotation % 360 != 0
    # The container's matrix turns the stored picture clockwise by `degrees`.
    np.testing.assert_array_equal(upright, np.rot90(stored, -degrees // 90))


def _patch_display_matrix(path: Path, clockwise_degrees: int) -> None:
    """Write a rotation into the mp4 track header, as phones do (ISO 14496-12, tkhd matrix)."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4
    assert data[start] == 0
    matrix = start + 40
    cos, sin = {90: (0, 1), 180: (-1, 0), 270: (0, -1)}[clockwise_degrees]
    values = (cos << 16, sin << 16, 0, -sin << 16, cos << 16, 0, 0, 0, 1 << 30)
    for number, value in enumerate(values):
        data[matrix + 4 * number : matrix + 4 * number + 4] = (value & 0xFFFFFFFF).to_bytes(
            4, "big"
        )
    path.write_bytes(bytes(data))


def test_what_cannot_be_read_is_the_users_error_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no video at"):
        FrameSource.open(tmp_path / "absent.mp4")
    noise = tmp_path / "noise.mp4"
    noise.write_bytes(b"this is no video" * 50)
    with pytest.raises(UserError, match="cannot be read"):
        list(FrameSource.open(noise))
    empty = tmp_path / "folder"
    empty.mkdir()
    with pytest.raises(UserError, match="holds no images"):
        list(FrameSource.open(empty))
    for name, told in (("a.png", "is not a PNG"), ("a.jpg", "cannot be decoded")):
        (empty / name).write_bytes(b"no picture")
        with pytest.raises(UserError, match=told):
            list(FrameSource.open(empty))
        (empty / name).unlink()


def test_clips_of_two_sizes_are_refused(tmp_path: Path) -> None:
    a = write_clip(tmp_path / "a.mp4", gradient_images(2))
    b = write_clip(tmp_path / "b.mp4", gradient_images(2, 64, 80))
    with pytest.raises(UserError, match="one size"):
        list(FrameSource.open([a, b]))


def test_a_sound_file_is_refused(tmp_path: Path) -> None:
    import wave

    path = tmp_path / "sound.wav"
    with wave.open(str(path), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(b"\0\0" * 800)
    with pytest.raises(UserError, match="no video stream"):
        list(FrameSource.open(path))


def test_a_file_that_breaks_off_gives_its_readable_part_and_a_note(tmp_path: Path) -> None:
    whole = write_clip(tmp_path / "whole.mkv", gradient_images(12))
    data = whole.read_bytes()
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(data[: len(data) * 2 // 3])
    source = FrameSource.open(cut)
    count = len(list(source))
    assert 0 < count < 12
