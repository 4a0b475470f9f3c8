"""A user's own mattes, which take precedence over ours."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.input.bars import NO_BARS, Bars
from rgbavatar_ns.tracking.input.image_files import (
    image_files,
    last_number,
    read_image_rgba,
    require_image_files,
)
from rgbavatar_ns.tracking.input.video import FrameSource, SourceFrame, counted_frames

_PERSON = 128
"""From here on a matte counts as the person."""
_AS_MANY = "Give one matte a frame: white (or opaque) is the person."


@dataclass(frozen=True)
class UserMattes:
    """Masks of a folder, or of a mask video, one for every frame of the source.

    Files go to frames by name where the source is one folder of images with the same names, else
    in the order of their numbers. A file's alpha channel counts where it has one, else its grey.
    """

    path: Path
    files: tuple[Path, ...] | None
    bars: Bars = NO_BARS
    """Of the film: they are cut off its mattes too."""

    @classmethod
    def open(cls, path: Path, source: FrameSource) -> "UserMattes":
        """Find the mattes; UserError where there are none, or files without a frame."""
        if not path.exists():
            raise UserError(f"There are no mattes at {path}.", "Check the path.")
        if not path.is_dir():
            return cls(path, None, source.bars)
        files = require_image_files(path)
        if len(source.paths) == 1 and source.paths[0].is_dir():
            named = _by_name(files, image_files(source.paths[0])[: source.max_frames])
            if named is not None:
                return cls(path, named, source.bars)
        numbers = [last_number(file) for file in files]
        if None not in numbers and len(set(numbers)) == len(numbers):
            files = [file for _, file in sorted(zip(numbers, files), key=lambda pair: pair[0] or 0)]
        return cls(path, tuple(files), source.bars)

    def require_somebody(self, max_frames: int | None) -> None:
        """UserError where none of the first so many mattes has anything light."""
        most = 0
        for _, matte in self._mattes(lambda index: True, max_frames):
            most = max(most, int(matte.max()))
            if most >= _PERSON:  # Mostly the first one's is.
                return
        raise UserError(
            f"The mattes in {self.path} are dark all over: the lightest place has {most} of 255.",
            "Make the person 255 (of masks with 0 and 1, 255 times as much) and the rest 0.",
        )

    def require_count(self, frames: int, limited: bool) -> None:
        """UserError unless each frame has a matte; too many are right if frames are limited.

        A mask video of another rate than the film's may hold but one in a hundred more.
        """
        if self.files is not None:
            count = len(self.files)
        elif limited:
            count = frames  # `levels` tells where it ends too soon.
        else:
            count = counted_frames(self.path, frames)
        if count < frames or (count > frames and not limited):
            raise UserError(
                f"{self.path} holds {count} mattes, the video has {frames} frames.", _AS_MANY
            )

    def levels(
        self, frames: frozenset[int], width: int, height: int
    ) -> Iterator[tuple[int, UInt8[np.ndarray, "H W"]]]:
        """The mattes of these frames within the bars, in order, with the frame's number.

        UserError where one is missing or has another size than the video.
        """
        last = -1
        for index, matte in self._mattes(frames.__contains__):
            if self.bars.within((matte.shape[1], matte.shape[0])) != (width, height):
                film = width + self.bars.left + self.bars.right
                raise UserError(
                    f"The matte of frame {index} in {self.path} has {matte.shape[1]} x "
                    f"{matte.shape[0]} pixels, the video {film} x "
                    f"{height + self.bars.top + self.bars.bottom}.",
                    "Bring mattes and video to one size.",
                )
            last = index
            yield index, np.ascontiguousarray(self.bars.cut(matte))
        if frames and last != max(frames):
            raise UserError(
                f"{self.path} ends before frame {max(frames)} of the video has a matte.", _AS_MANY
            )

    def _mattes(
        self, wanted: Callable[[int], bool], max_frames: int | None = None
    ) -> Iterator[tuple[int, UInt8[np.ndarray, "H W"]]]:
        if self.files is not None:
            for index, file in enumerate(self.files[:max_frames]):
                if wanted(index):
                    yield index, _level(read_image_rgba(file))
            return
        for frame in FrameSource.open(self.path, max_frames).read(wanted):
            grey = cv2.cvtColor(frame.image_rgb, cv2.COLOR_RGB2GRAY)
            yield frame.index, grey if frame.alpha is None else frame.alpha


def given_mattes(
    frames: Iterable[SourceFrame],
    wanted: frozenset[int],
    mattes: UserMattes | None,
    source_alpha: bool,
) -> Iterator[tuple[SourceFrame, UInt8[np.ndarray, "H W"] | None]]:
    """The wanted frames, which are these, each with the matte that the user gave of it.

    It is one of `mattes`, else the film's alpha where `source_alpha` (a frame without one is the
    person all over), as large as the frame's image; None where mattes are to be found.
    """
    levels = None
    for frame in frames:
        height, width = frame.image_rgb.shape[:2]
        if mattes is not None:
            levels = levels or mattes.levels(wanted, frame.width, frame.height)
            level = next(levels)[1]
            yield frame, cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA)
        elif source_alpha and frame.alpha is None:
            yield frame, np.full((height, width), 255, np.uint8)
        else:
            yield frame, frame.alpha if source_alpha else None


def _level(image: UInt8[np.ndarray, "H W C"]) -> UInt8[np.ndarray, "H W"]:
    """A matte's alpha where that is not opaque all over, else its grey."""
    if image.shape[2] == 4 and image[..., 3].min() < 255:
        return np.ascontiguousarray(image[..., 3])
    return cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2GRAY)


def _by_name(mattes: list[Path], images: list[Path]) -> tuple[Path, ...] | None:
    """Each image's matte, if all names agree; None if none does; UserError if only some do."""
    by_stem = {matte.stem: matte for matte in mattes}
    missing = [image.stem for image in images if image.stem not in by_stem]
    if len(missing) == len(images):
        return None
    if missing:
        raise UserError(
            f"{mattes[0].parent} has no matte named {missing[0]} ({len(missing)} of "
            f"{len(images)} images have none).",
            _AS_MANY,
        )
    return tuple(by_stem[image.stem] for image in images)
