"""Frames to films and pictures, with PyAV (FFmpeg's libraries come inside its wheel)."""

from collections.abc import Iterable
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import OutputContainer
from av.filter import Graph
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from jaxtyping import UInt8

from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.files import atomic_write, disk_errors, keep_numbered

_BT709 = 1
"""Primaries and transfer, as H.264 numbers them."""
_GIF_TICKS = 100
"""A second."""
_GIF_SHORTEST_CS = 2
"""Browsers show a picture that is to last less for a tenth of a second."""


class FilmWriter:
    """Encodes RGB frames as H.264, as they come; within `with`.

    The file appears under its name only when it is complete, and not at all where an error ends
    it. All frames have one size; of an odd side the last row or column is there twice, as the codec
    asks. Colours are those of BT.709, and said to be.
    """

    def __init__(self, path: Path, frames_per_second: float = 25.0) -> None:
        self._path, self._rate = path, Fraction(frames_per_second).limit_denominator(1001)
        self._open = ExitStack()
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self.count = 0

    def __enter__(self) -> "FilmWriter":
        """Begin the file."""
        with ExitStack() as opening:
            partial = opening.enter_context(atomic_write(self._path))
            self._container = opening.enter_context(
                av.open(str(partial.absolute()), "w", format="mp4")
            )
            self._open = opening.pop_all()
        return self

    def add(self, frame: UInt8[np.ndarray, "H W 3"]) -> None:
        """Encode one more frame; raises DiskError where the file's place refuses it."""
        assert self._container is not None
        sides = [(0, side % 2) for side in frame.shape[:2]]
        frame = np.pad(frame, (*sides, (0, 0)), mode="edge")
        if self._stream is None:
            self._stream = self._begun(*frame.shape[:2])
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
        coded = picture.reformat(
            format="yuv420p",
            dst_colorspace=Colorspace.ITU709,
            dst_color_range=ColorRange.MPEG,
        )
        with disk_errors(self._path):  # The file is opened with its first bytes.
            self._container.mux(self._stream.encode(coded))
        self.count += 1

    def _begun(self, height: int, width: int) -> VideoStream:
        """A stream that says how its colours are coded: players guess otherwise, and differ."""
        assert self._container is not None
        stream = self._container.add_stream("libx264", rate=self._rate)
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        stream.options = {"crf": "18"}
        stream.codec_context.colorspace = Colorspace.ITU709
        stream.codec_context.color_range = ColorRange.MPEG
        stream.codec_context.color_primaries = stream.codec_context.color_trc = _BT709
        return stream

    def __exit__(self, *raised: Any) -> bool | None:
        """Complete the file, or leave none."""
        if raised[0] is not None:
            return self._open.__exit__(*raised)
        with self._open:
            if self._stream is not None:
                assert self._container is not None
                self._container.mux(self._stream.encode(None))
        return None


def write_video(path: Path, frames: Iterable[np.ndarray], frames_per_second: float = 25.0) -> int:
    """Write RGB frames, uint8 [H, W, 3], as `FilmWriter` does, and return their number."""
    with FilmWriter(path, frames_per_second) as film:
        for frame in frames:
            film.add(frame)
    return film.count


def write_gif(path: Path, frames: Iterable[np.ndarray], frames_per_second: float = 25.0) -> int:
    """Encode RGB frames as an endless GIF with a palette made for them; return their number.

    frames: uint8 [H, W, 3], all of one size, at least one. Kept in memory until the palette is
    known. GIFs count time in hundredths of a second, and viewers show no picture for less than two:
    above 50 frames a second some are left out, so that the film takes as long as it should.
    """
    kept: list[np.ndarray] = []
    times_cs: list[int] = []
    count = 0
    for count, frame in enumerate(frames, start=1):
        due_cs = _GIF_TICKS * (count - 1) / frames_per_second
        earliest_cs = times_cs[-1] + _GIF_SHORTEST_CS if times_cs else 0
        # What is due less than a tick before comes a little late rather than not at all.
        if due_cs >= earliest_cs - 1:
            kept.append(np.ascontiguousarray(frame))
            times_cs.append(max(round(due_cs), earliest_cs))
    end_cs = round(_GIF_TICKS * count / frames_per_second)
    last_cs = max(end_cs - times_cs[-1], _GIF_SHORTEST_CS)
    height, width = kept[0].shape[:2]
    graph = _palette_graph(width, height)
    for frame, time_cs in zip(kept, times_cs):
        picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
        picture.pts = time_cs
        graph.push(picture)
    graph.push(None)
    # A picture lasts until the next one; the last one has none.
    options = {"final_delay": str(last_cs)}
    with (
        atomic_write(path) as partial,
        av.open(str(partial.absolute()), "w", format="gif", options=options) as container,
    ):
        stream = container.add_stream("gif", rate=_GIF_TICKS)
        stream.height, stream.width, stream.pix_fmt = height, width, "pal8"
        for time_cs in times_cs:
            picture = graph.pull()
            picture.pts = time_cs
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return len(kept)


def _palette_graph(width: int, height: int) -> Graph:
    """FFmpeg's filters: one branch collects a palette, the other one uses it."""
    graph = Graph()
    source = graph.add(
        "buffer",
        f"video_size={width}x{height}:pix_fmt=rgb24:time_base=1/{_GIF_TICKS}:pixel_aspect=1/1",
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
    """Write frames as 00000.png and so on, RGB or RGBA with straight alpha; return their number.

    Later numbers, of a longer sequence that was here before, are removed.
    """
    count = 0
    for count, frame in enumerate(frames, start=1):
        write_png(folder / f"{count - 1:05d}.png", frame)
    keep_numbered(folder, ".png", range(count))
    return count


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write one picture, uint8 [H, W, 3] or [H, W, 4] with straight alpha."""
    if picture.shape[-1] == 3:
        picture = np.concatenate([picture, np.full_like(picture[..., :1], 255)], -1)
    with atomic_write(path) as partial:
        partial.write_bytes(encode_png_rgba(picture))
