"""Frames of videos and image folders, upright, with square pixels, in order."""

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import av
import cv2
import numpy as np
from av.codec.codec import UnknownCodecError
from av.container import InputContainer
from av.error import FFmpegError
from av.sidedata.sidedata import SideDataContainer
from av.sidedata.sidedata import Type as SideData
from av.stream import Disposition
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import Interpolation
from av.video.stream import VideoStream
from jaxtyping import UInt8

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.input.bars import NO_BARS, Bars, find_bars
from rgbavatar_ns.tracking.input.hdr import hdr_to_srgb, hdr_transfer
from rgbavatar_ns.tracking.input.image_files import (
    fitted_size,
    image_files,
    read_image_rgba,
    require_image_files,
)

_GLANCES = 8
"""Pictures of a clip by which its bars are known."""
_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}
"""By codec."""


@dataclass(frozen=True)
class SourceFrame:
    """One frame: `index` runs over all clips together, `clip` says which one it is from.

    `width` and `height` are the whole frame's; the image may have been read smaller.
    `alpha` is None where everything is opaque; `time_s` where the source has no clock.
    """

    index: int
    clip: int
    image_rgb: UInt8[np.ndarray, "h w 3"]
    alpha: UInt8[np.ndarray, "h w"] | None
    width: int
    height: int
    time_s: float | None


@dataclass(frozen=True)
class _Undecoded:
    """A frame whose image is made when it is wanted; at most `max_side` pixels long."""

    size: tuple[int, int]
    time_s: float | None
    image: Callable[[int | None], UInt8[np.ndarray, "h w *C"]]


@dataclass
class FrameSource:
    """Clips of one speaker, read as often as wanted, one frame in memory at a time.

    Each path is a file that PyAV reads or a folder of images (sorted by name). All frames must
    have one size, since they share a camera. `notes` collects what a reader should know about
    damaged clips. `bars` are cut off each frame. Raises UserError for what cannot be read.
    """

    paths: tuple[Path, ...]
    max_frames: int | None = None
    bars: Bars = NO_BARS
    notes: list[str] = field(default_factory=list)

    @classmethod
    def open(
        cls, videos: Path | str | Sequence[Path | str], max_frames: int | None = None
    ) -> "FrameSource":
        """Check that every path exists and that folders hold images; videos are read later."""
        listed = [videos] if isinstance(videos, str | Path) else list(videos)
        if not listed:
            raise UserError("No video was given.", "Name at least one video file or image folder.")
        for path in map(Path, listed):
            if not path.exists():
                raise UserError(f"There is no video at {path}.", "Check the path.")
            if path.is_dir():
                require_image_files(path)
            elif path.stat().st_size == 0:
                raise UserError(f"{path} is empty (0 bytes).", "Copy or record it again.")
        return cls(tuple(map(Path, listed)), max_frames)

    def without_bars(self) -> "FrameSource":
        """The same without the bars of one colour that all clips have, by a few glances at each."""
        pictures = (picture for path in self.paths for picture in glances(path, self.max_frames))
        return replace(self, bars=find_bars(pictures))

    def __iter__(self) -> Iterator[SourceFrame]:
        """Every frame of every clip; the order and the indices are the same each time."""
        return self.read()

    def read(
        self,
        wanted: Callable[[int], bool] = lambda index: True,
        max_side: int | None = None,
    ) -> Iterator[SourceFrame]:
        """The wanted frames, their images no longer than `max_side`; the others cost little."""
        self.notes.clear()
        index, size = 0, None
        for clip, path in enumerate(self.paths):
            for frame in self._folder(path) if path.is_dir() else self._video(path):
                if self.max_frames is not None and index >= self.max_frames:
                    return
                if size is not None and frame.size != size:
                    raise UserError(
                        f"{path}: a frame has {frame.size[0]} x {frame.size[1]} pixels, the "
                        f"ones before it {size[0]} x {size[1]}.",
                        "Bring all clips to one size; they share one camera.",
                    )
                size = frame.size
                if wanted(index):
                    image = self._within_bars(frame, max_side)
                    alpha = np.ascontiguousarray(image[..., 3]) if image.shape[2] == 4 else None
                    if alpha is not None and alpha.min() == 255:
                        alpha = None
                    color = np.ascontiguousarray(image[..., :3])
                    within = self.bars.within(size)
                    yield SourceFrame(index, clip, color, alpha, *within, frame.time_s)
                index += 1

    def _within_bars(self, frame: _Undecoded, max_side: int | None) -> UInt8[np.ndarray, "h w C"]:
        if not any(self.bars):
            return frame.image(max_side)
        whole = self.bars.cut(frame.image(None))
        smaller = fitted_size(*self.bars.within(frame.size), max_side)
        return cv2.resize(whole, smaller, interpolation=cv2.INTER_AREA)

    def these(self, indices: Collection[int], max_side: int | None = None) -> Iterator[SourceFrame]:
        """These frames alone; behind the last of them nothing is decoded."""
        last = max(indices, default=-1)
        for frame in self.read(frozenset(indices).__contains__, max_side) if last >= 0 else ():
            yield frame
            if frame.index == last:
                return

    def count_hint(self) -> int | None:
        """How many frames to expect, for a progress bar; None where a file does not say."""
        total = 0
        for path in self.paths:
            count = len(image_files(path)) if path.is_dir() else _expected_frames(path)
            if not count:
                return None
            total += count
        return total if self.max_frames is None else min(total, self.max_frames)

    def _folder(self, folder: Path) -> Iterator[_Undecoded]:
        files = require_image_files(folder)
        # The first image's size is enough for those that are passed over unread.
        height, width = read_image_rgba(files[0]).shape[:2]
        for path in files:
            yield _Undecoded((width, height), None, partial(_image_of_size, path, width, height))

    def _video(self, path: Path) -> Iterator[_Undecoded]:
        decoded, damaged, broken = 0, 0, None
        try:
            with _opened(path) as container:
                stream = _image_stream(container, path)
                stream.thread_type = "AUTO"
                aspect = stream.sample_aspect_ratio or Fraction(1)
                with _at_rest_afterwards(self._alpha_decoder(stream, path)) as decoder:
                    for packet in container.demux(stream):
                        try:
                            frames = decoder.decode(packet)
                        except FFmpegError as error:
                            damaged, broken = damaged + 1, error
                            continue
                        for frame in frames:
                            decoded += 1
                            damaged += bool(frame.is_corrupt)
                            yield _upright(frame, aspect)
                declared = stream.frames
        except (FFmpegError, OSError) as error:
            if not decoded:
                raise _unreadable(path, error) from error
            self.notes.append(f"{path.name} breaks off after {decoded} frames ({error})")
            return
        if not decoded and broken is not None:
            raise _unreadable(path, broken)
        if not decoded:
            raise UserError(f"{path} holds no frame.", "Give a video with at least one frame.")
        if damaged:
            self.notes.append(f"{path.name}: {damaged} frames or packets are damaged")
        if declared and decoded < declared and not damaged:
            self.notes.append(f"{path.name} holds {decoded} of the {declared} frames it announces")

    def _alpha_decoder(self, stream: VideoStream, path: Path) -> VideoCodecContext:
        """The stream's own decoder, or one that gives the alpha channel which that leaves out."""
        own = stream.codec_context
        name = _ALPHA_DECODERS.get(own.codec.canonical_name)
        if name is None or stream.metadata.get("alpha_mode") != "1":
            return own
        try:
            decoder = VideoCodecContext.create(name, "r")
        except UnknownCodecError:
            self.notes.append(
                f"{path.name}: its alpha channel cannot be read here (no {name}), so it is not used"
            )
            return own
        assert isinstance(decoder, VideoCodecContext)
        decoder.extradata, decoder.thread_type = own.extradata, own.thread_type
        return decoder


def _image_of_size(
    path: Path, width: int, height: int, max_side: int | None
) -> UInt8[np.ndarray, "h w 4"]:
    image = read_image_rgba(path)
    if image.shape[:2] != (height, width):
        raise UserError(
            f"{path} has {image.shape[1]} x {image.shape[0]} pixels, the images before it "
            f"{width} x {height}.",
            "Bring all images to one size; they share one camera.",
        )
    smaller = fitted_size(width, height, max_side)
    if smaller == (width, height):
        return image
    return cv2.resize(image, smaller, interpolation=cv2.INTER_AREA)


def _opened(path: Path) -> InputContainer:
    # A relative name with a colon would be taken for a protocol.
    return av.open(str(path.absolute()))


@contextmanager
def _at_rest_afterwards(decoder: VideoCodecContext) -> Iterator[VideoCodecContext]:
    """The decoder, whose threads are waited for before anything can free it.

    PyAV frees it while it holds Python's lock, and torchvision, once imported, has FFmpeg's errors
    told through Python: a thread that met damage behind the last frame read would wait for ever.
    """
    try:
        yield decoder
    finally:
        decoder.flush_buffers()


def _image_stream(container: InputContainer, path: Path) -> VideoStream:
    """The first stream of images; a cover image in a sound file is none."""
    for stream in container.streams.video:
        if not stream.disposition & Disposition.attached_pic:
            return stream
    raise UserError(f"{path} holds no video stream.", "Give a file with images.")


def _upright(frame: av.VideoFrame, aspect: Fraction) -> _Undecoded:
    """The frame turned and mirrored as its metadata asks, with pixels made square in width."""
    width = max(1, round(frame.width * aspect)) if aspect > 0 else frame.width
    stored = (width, frame.height)
    turns, mirrored = _turns_and_mirror(frame)
    has_alpha = any(part.is_alpha for part in frame.format.components)
    transfer = hdr_transfer(frame.color_trc)
    layout = "rgba" if has_alpha else "rgb24"
    if transfer is not None:
        layout = "rgba64le" if has_alpha else "rgb48le"

    def image(max_side: int | None) -> UInt8[np.ndarray, "h w *C"]:
        wide, high = fitted_size(*stored, max_side)
        if (wide, high) == (frame.width, frame.height):
            pixels = frame.to_ndarray(format=layout)
        else:
            pixels = frame.reformat(
                wide, high, format=layout, interpolation=Interpolation.AREA
            ).to_ndarray()
        if transfer is not None:
            pixels = hdr_to_srgb(pixels, transfer, frame.color_primaries)
        return np.ascontiguousarray(np.rot90(pixels[:, ::-1] if mirrored else pixels, turns))

    size = (frame.height, width) if turns % 2 else stored
    return _Undecoded(size, frame.time, image)


def _turns_and_mirror(frame: av.VideoFrame) -> tuple[int, bool]:
    """Quarter turns counterclockwise, after the image was mirrored left to right or not.

    From the display matrix (ISO 14496-12, tkhd). `frame.rotation` knows no mirror, and takes one
    for half a turn.
    """
    try:
        # Kept apart: in a ring with its own `side_data`, a frame would wait in memory for gc.
        parts = SideDataContainer(frame)  # pyright: ignore[reportCallIssue]
    except ValueError:  # PyAV before 19 met a kind of data that it has no name for.
        return round(frame.rotation / 90) % 4, False
    matrix = parts.get(SideData.DISPLAYMATRIX)
    if matrix is None:
        return 0, False
    a, b, _, c, d = np.frombuffer(matrix, np.int32)[:5].astype(float).tolist()
    mirrored = a * d < b * c
    if mirrored:
        a, b = -a, -b
    return round(-math.atan2(b, a) / (math.pi / 2)) % 4, mirrored


def glances(path: Path, max_frames: int | None) -> Iterator[UInt8[np.ndarray, "h w C"]]:
    """A few pictures spread over a clip; fewer, or none, of a video that cannot be read.

    None of an image beyond the first `max_frames`, which nobody reads.
    """
    if path.is_dir():
        files = image_files(path)[:max_frames]
        for position in sorted({round(k) for k in np.linspace(0, len(files) - 1, _GLANCES)}):
            yield read_image_rgba(files[position])
        return
    # Reading the clip tells, or notes, what is damaged.
    with suppress(FFmpegError, OSError, StopIteration), _opened(path) as container:
        stream = _image_stream(container, path)
        aspect = stream.sample_aspect_ratio or Fraction(1)
        for part in range(_GLANCES):
            if part and container.duration:
                begun, away = container.start_time or 0, part * container.duration // _GLANCES
                container.seek(begun + away)
            yield _upright(next(container.decode(stream)), aspect).image(None)


def _unreadable(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path} cannot be read as a video ({error}).",
        "Give a file that ffmpeg can decode, or a folder of images.",
    )


def counted_frames(path: Path, expected: int) -> int:
    """How many frames a video holds, whatever it announces.

    It is decoded only where its packets, which are quick to count, are not as many as expected.
    Raises UserError for what cannot be read.
    """
    try:
        with _opened(path) as container:
            packets = container.demux(_image_stream(container, path))
            if expected == sum(one.size > 0 and not one.is_discard for one in packets):
                return expected
    except (FFmpegError, OSError) as error:
        raise _unreadable(path, error) from error
    decoded = FrameSource.open(path)._video(path)
    return sum(1 for _ in decoded)


def _expected_frames(path: Path) -> int:
    """As announced, or by the mean rate, which is wrong where rates vary; 0 where unknown."""
    try:
        with _opened(path) as container:
            stream = _image_stream(container, path)
            if stream.frames:
                return stream.frames
            if stream.average_rate is None or container.duration is None:
                return 0
            return round(container.duration / av.time_base * float(stream.average_rate))
    except (FFmpegError, OSError, UserError):
        return 0
