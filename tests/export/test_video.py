import resource
from contextlib import suppress

import av
import numpy as np
import pytest
from av.video.reformatter import ColorRange, Colorspace
from PIL import Image

from rgbavatar_ns.export import write_gif, write_video
from rgbavatar_ns.export.live_pictures import FilmSink
from rgbavatar_ns.files import DiskError


def test_a_film_holds_the_frames_it_was_given(tmp_path):
    shades = [40, 120, 200]
    frames = [np.full((31, 48, 3), shade, dtype=np.uint8) for shade in shades]
    path = tmp_path / "film.mp4"
    assert write_video(path, frames, frames_per_second=10.0) == 3
    with av.open(str(path)) as container:
        read = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
        assert container.streams.video[0].average_rate == 10
    assert [f.shape for f in read] == [(32, 48, 3)] * 3
    for frame, shade in zip(read, shades):
        assert abs(int(np.median(frame)) - shade) <= 3
        assert np.abs(frame[31].astype(int) - frame[30]).max() <= 3, "the row more is no dark line"
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]


def test_a_film_says_how_its_colours_are_coded_and_keeps_to_it(tmp_path):
    color = np.array([200, 30, 40])
    path = tmp_path / "film.mp4"
    write_video(path, [np.full((32, 32, 3), color, dtype=np.uint8)] * 2)
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
    assert (frame.colorspace, frame.color_range) == (Colorspace.ITU709, ColorRange.MPEG)
    # BT.709's luma by hand, from 16 to 235.
    luma = 16 + 219 / 255 * (np.array([0.2126, 0.7152, 0.0722]) @ color)
    assert frame.to_ndarray()[16, 16] == pytest.approx(luma, abs=2)


@pytest.mark.parametrize(
    ("rate", "written", "lasts_cs"),
    [
        (60.0, 50, {2}),
        (51.0, 58, {2, 3}),
        (50.0, 60, {2}),
        (30.0, 60, {3, 4}),
        (12.5, 60, {8}),
        (0.4, 60, {250}),
    ],
)
def test_a_gif_takes_as_long_as_its_frames(rate, written, lasts_cs, tmp_path):
    shades = np.arange(60) * 4
    frames = [np.full((8, 8, 3), shade, dtype=np.uint8) for shade in shades]
    path = tmp_path / "film.gif"
    assert write_gif(path, frames, rate) == written
    found_cs, seen = [], []
    with Image.open(path) as film:
        for place in range(film.n_frames):
            film.seek(place)
            found_cs.append(film.info["duration"] // 10)
            seen.append(film.convert("L").getpixel((4, 4)))
    assert len(found_cs) == written
    assert set(found_cs) == lasts_cs
    assert sum(found_cs) == pytest.approx(100 * 60 / rate, abs=1)
    # Each is shown when it is due, but for a tick.
    begins_cs = np.cumsum([0, *found_cs[:-1]])
    due_cs = 100 / rate * np.array(seen) / 4
    assert np.abs(begins_cs - due_cs).max() <= 1.01
    assert np.all(np.diff(seen) > 0)


@pytest.fixture
def full_disk():
    """No file of this process may grow any more: what the system says, it says with the write."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("frames", [1, 200])
def test_a_film_that_the_disk_refuses_is_told_by_its_name_and_leaves_nothing(
    frames, tmp_path, full_disk
):
    noise = np.random.default_rng(0).integers(0, 256, (frames, 64, 64, 3)).astype(np.uint8)
    with pytest.raises(DiskError, match=r"Cannot write .*/film\.mp4: File too large\."):
        write_video(tmp_path / "film.mp4", noise)
    sink = FilmSink(tmp_path / "film.mp4", 25.0)

    def drive():
        try:
            for place, frame in enumerate(noise):
                sink.add(frame, place / 25.0)
        except DiskError:
            with suppress(DiskError):  # Whoever drives closes it all the same.
                sink.close()
            raise
        sink.close()

    with pytest.raises(DiskError, match=r"Cannot write .*/film\.mp4: File too large\."):
        drive()
    with pytest.raises(DiskError, match=r"Cannot write .*/film\.gif: File too large\."):
        write_gif(tmp_path / "film.gif", noise)
    assert list(tmp_path.iterdir()) == []
