"""Frames of videos and image folders, upright, with square pixels, in order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import av
import cv2
import numpy as np
from av.error import FFmpegError
from jaxtyping import UInt8

from rgbavatar_ns.errors import UserError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")


@dataclass(frozen=True)
class SourceFrame:
    """One frame: `index` runs over all clips together, `clip` says which one it is from."""

    index: int
    clip: int
    image_rgb: UInt8[np.ndarray, "H W 3"]


@dataclass
class FrameSource:
    """Clips of one speaker, read as often as wanted, one frame in memory at a time.

    Each path is a file that PyAV reads or a folder of images (sorted by name). All frames must
    have one size, since they share a camera. `notes` collects what a reader should know about
    damaged clips. Raises UserError for what cannot be read.
    """

    paths: tuple[Path, ...]
    max_frames: int | None = None
    notes: list[str] = field(default_factory=list)

    @classmethod
    def open(
        cls, videos: Path | str | Sequence[Path | str], max_frames: int | None = None
    ) -> "FrameSource":
        """Check that every path exists; the frames themselves are read later."""
        listed = [videos] if isinstance(videos, str | Path) else list(videos)
        if not listed:
            raise UserError("No video was given.", "Name at least one video file or image folder.")
        for path in map(Path, listed):
            if not path.exists():
                raise UserError(f"There is no video at {path}.", "Check the path.")
        return cls(tuple(map(Path, listed)), max_frames)

    def __iter__(self) -> Iterator[SourceFrame]:
        """Every frame of every clip; the order and the indices are the same each time."""
        self.notes.clear()
        index, size = 0, None
        for clip, path in enumerate(self.paths):
            for image in _folder_images(path) if path.is_dir() else self._video_images(path):
                if self.max_frames is not None and index >= self.max_frames:
                    return
                if size is not None and image.shape[:2] != size:
                    raise UserError(
                        f"{path}: a frame has {image.shape[1]} x {image.shape[0]} pixels, the "
                        f"ones before it {size[1]} x {size[0]}.",
                        "Bring all clips to one size; they share one camera.",
                    )
                size = image.shape[:2]
                yield SourceFrame(index, clip, image)
                index += 1

    def count_hint(self) -> int | None:
        """How many frames to expect, for a progress bar; None where a file does not say."""
        total = 0
        for path in self.paths:
            count = len(_image_files(path)) if path.is_dir() else _declared_frames(path)
            if not count:
                return None
            total += count
        return total if self.max_frames is None else min(total, self.max_frames)

    def _video_images(self, path: Path) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        decoded = 0
        try:
            with av.open(str(path)) as container:
                if not container.streams.video:
                    raise UserError(f"{path} holds no video stream.", "Give a file with pictures.")
                stream = container.streams.video[0]
                stream.thread_type = "AUTO"
                for frame in container.decode(stream):
                    decoded += 1
                    yield _upright_square_pixels(frame)
        except (FFmpegError, OSError) as error:
            if not decoded:
                raise UserError(
                    f"{path} cannot be read as a video ({error}).",
                    "Give a file that ffmpeg can decode, or a folder of images.",
                ) from error
            self.notes.append(f"{path.name} breaks off after {decoded} frames ({error})")
        if not decoded:
            raise UserError(f"{path} holds no frame.", "Give a video with at least one frame.")


def _upright_square_pixels(frame: av.VideoFrame) -> UInt8[np.ndarray, "H W 3"]:
    """The decoded picture, turned as its rotation metadata asks and with square pixels."""
    image = frame.to_ndarray(format="rgb24")
    aspect = getattr(frame, "sample_aspect_ratio", None)
    if aspect is not None and aspect > 0 and aspect != 1:
        width = max(1, round(image.shape[1] * float(aspect)))
        image = cv2.resize(image, (width, image.shape[0]), interpolation=cv2.INTER_AREA)
    quarter_turns = round(getattr(frame, "rotation", 0) / 90) % 4
    return np.ascontiguousarray(np.rot90(image, quarter_turns))


def _image_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)


def _folder_images(folder: Path) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    files = _image_files(folder)
    if not files:
        raise UserError(
            f"{folder} holds no images.", f"Put files ending in {', '.join(IMAGE_SUFFIXES)} there."
        )
    for path in files:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise UserError(f"{path} cannot be decoded as an image.", "Remove or replace it.")
        yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _declared_frames(path: Path) -> int:
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            if stream.frames:
                return stream.frames
            if stream.average_rate is None or container.duration is None:
                return 0
            return round(container.duration / av.time_base * float(stream.average_rate))
    except (FFmpegError, OSError, IndexError):
        return 0
