"""Frames to films and pictures, with PyAV (FFmpeg's libraries come inside its wheel)."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.filter import Graph

from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.files import atomic_write


def write_video(path: Path, frames: Iterable[np.ndarray], frames_per_second: float = 25.0) -> int:
    """Encode RGB frames as H.264 and return their number.

    frames: uint8 [H, W, 3], all of one size; an odd size is padded by one pixel, as the codec
    asks. The file appears under its name only when it is complete.
    """
    count = 0
    with atomic_write(path) as partial, av.open(str(partial), "w", format="mp4") as container:
        stream = None
        for frame in frames:
            frame = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)))
            if stream is None:
                rate = Fraction(frames_per_second).limit_denominator(1001)
                stream = container.add_stream("libx264", rate=rate)
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.options = {"crf": "18"}
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            container.mux(stream.encode(picture))
            count += 1
        if stream is not None:
            container.mux(stream.encode(None))
    return count


def write_gif(path: Path, frames: Iterable[np.ndarray], frames_per_second: float = 25.0) -> int:
    """Encode RGB frames as an endless GIF with a palette made for them; return their number.

    frames: uint8 [H, W, 3], all of one size, at least one. Kept in memory until the palette is
    known. GIFs count time in hundredths of a second; above 50 frames a second viewers slow down.
    """
    kept = [np.ascontiguousarray(frame) for frame in frames]
    height, width = kept[0].shape[:2]
    rate = max(1, min(round(frames_per_second), 50))
    graph = _palette_graph(width, height, rate)
    for place, frame in enumerate(kept):
        picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
        picture.pts = place
        graph.push(picture)
    graph.push(None)
    with atomic_write(path) as partial, av.open(str(partial), "w", format="gif") as container:
        stream = container.add_stream("gif", rate=rate)
        stream.height, stream.width, stream.pix_fmt = height, width, "pal8"
        for place in range(len(kept)):
            picture = graph.pull()
            picture.pts = place
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return len(kept)


def _palette_graph(width: int, height: int, rate: int) -> Graph:
    """FFmpeg's filters: one branch collects a palette, the other one uses it."""
    graph = Graph()
    source = graph.add(
        "buffer", f"video_size={width}x{height}:pix_fmt=rgb24:time_base=1/{rate}:pixel_aspect=1/1"
    )
    split, collect = graph.add("split"), graph.add("palettegen", "stats_mode=full")
    use, sink = graph.add("paletteuse", "dither=sierra2_4a"), graph.add("buffersink")
    source.link_to(split)
    split.link_to(use, 0, 0)
    split.link_to(collect, 1, 0)
    collect.link_to(use, 0, 1)
    use.link_to(sink)
    graph.configure()
    return graph


def write_pngs(folder: Path, frames: Iterable[np.ndarray]) -> int:
    """Write frames as 00000.png and so on, RGB or RGBA with straight alpha; return their number."""
    count = 0
    for count, frame in enumerate(frames, start=1):
        write_png(folder / f"{count - 1:05d}.png", frame)
    return count


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write one picture, uint8 [H, W, 3] or [H, W, 4] with straight alpha."""
    if picture.shape[-1] == 3:
        picture = np.concatenate([picture, np.full_like(picture[..., :1], 255)], -1)
    with atomic_write(path) as partial:
        partial.write_bytes(encode_png_rgba(picture))
