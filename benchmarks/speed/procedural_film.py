"""A procedural person before a still wall, as a video: made in parts, so that it can go on."""

from collections.abc import Iterator
from itertools import count
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8
from rich.progress import track

from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.synthetic import DemoConfig, film_demo
from rgbavatar_ns.synthetic.make import DemoFilm
from rgbavatar_ns.synthetic.performer.performance import Body

FRAMES_PER_SECOND = 24
_ROOM_CELLS = 64
"""The room is so many patches wide: something for a camera's motion to show in."""
_PART_FRAMES = 250
_BITS_PER_SECOND = 8_000_000


def film_config(frames: int, size_px: int, seed: int = 3, body: Body = "lean") -> DemoConfig:
    """A person without glasses who talks and, by default, leans to all sides."""
    return DemoConfig(
        image_size=size_px,
        num_frames=frames,
        num_test_frames=min(4, frames - 1),
        seed=seed,
        frames_per_second=float(FRAMES_PER_SECOND),
        theta_noise=0.0,
        supersampling=1,
        glasses=False,
        body=body,
    )


def write_film(path: Path, config: DemoConfig) -> None:
    """Write the film to `path`; parts that an interrupted call left beside it are not made again.

    Parts are streams of their own, put after one another as they are.
    """
    starts = range(0, config.num_frames, _PART_FRAMES)
    parts = [path.with_name(f"{path.stem}_{start:06d}{path.suffix}") for start in starts]
    film: DemoFilm | None = None
    for start, part in track(list(zip(starts, parts)), "Filming..."):
        if not part.exists():
            film = film or film_demo(config)
            theta = film.true[start : start + _PART_FRAMES]
            with atomic_write(part) as partial:
                _encode(partial, _before_wall(film.person.draw(theta), config), config.image_size)
    with atomic_write(path) as partial:
        _join(partial, parts)
    for part in parts:
        part.unlink()


def _before_wall(
    images_rgba: Iterator[UInt8[np.ndarray, "S S 4"]], config: DemoConfig
) -> Iterator[UInt8[np.ndarray, "S S 3"]]:
    cells = np.random.default_rng(config.seed).integers(60, 200, (_ROOM_CELLS, _ROOM_CELLS, 3))
    row = np.arange(config.image_size) * _ROOM_CELLS // config.image_size
    room = cells[row][:, row].astype(np.float32)
    for image in images_rgba:
        alpha = image[..., 3:].astype(np.float32) / 255
        yield (image[..., :3] * alpha + room * (1 - alpha)).astype(np.uint8)


def _encode(path: Path, images_rgb: Iterator[UInt8[np.ndarray, "S S 3"]], size_px: int) -> None:
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("mpeg4", rate=FRAMES_PER_SECOND)
        stream.width = stream.height = size_px
        stream.pix_fmt, stream.bit_rate = "yuv420p", _BITS_PER_SECOND
        for image in images_rgb:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def _join(path: Path, parts: list[Path]) -> None:
    """The parts' packets in one file; none of them refers to another part's."""
    with av.open(str(path), "w", format="mp4") as joined:
        written, stream = count(), None
        for part in parts:
            with av.open(str(part)) as container:
                of_part = container.streams.video[0]
                stream = stream or joined.add_stream_from_template(of_part)
                for packet in container.demux(of_part):
                    if packet.size:
                        packet.pts = packet.dts = next(written)
                        packet.time_base = 1 / of_part.average_rate
                        packet.stream = stream
                        joined.mux(packet)
