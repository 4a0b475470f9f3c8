import av
import numpy as np

from rgbavatar_ns.export import write_video


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
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]
