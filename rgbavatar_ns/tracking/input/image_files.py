"""Images of a folder, in the order of their numbers, whatever depth and channels they have."""

import re
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from rgbavatar_ns.data.image_headers import header_size
from rgbavatar_ns.data.jpeg import JPEG_START, is_truncated_jpeg
from rgbavatar_ns.data.png import (
    MAX_IMAGE_BYTES,
    PNG_START,
    decode_png_rgba,
    read_png_rgba,
    require_bounded,
)
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import digest, digest_of_file
from rgbavatar_ns.reading import DamagedFileError, read_file

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")
_NEVER_ALPHA = (".jpg", ".jpeg", ".bmp")


def image_files(folder: Path) -> list[Path]:
    """The folder's images, 2 before 10; other files and hidden ones are passed over."""
    return sorted(
        (
            path
            for path in folder.iterdir()
            if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
        ),
        key=lambda path: (_natural(path.stem), path.name),
    )


def require_image_files(folder: Path) -> list[Path]:
    """As `image_files`; UserError where there are none."""
    files = image_files(folder)
    if not files:
        raise UserError(
            f"{folder} holds no images.", f"Put files ending in {', '.join(IMAGE_SUFFIXES)} there."
        )
    return files


def source_digest(path: Path) -> str:
    """What tells one source from another: of a file its size and samples of its content, of a
    folder its images' names, sizes and times."""
    if not path.is_dir():
        return digest_of_file(path)
    facts = [(image.name, image.stat()) for image in image_files(path)]
    return digest(f"{name}|{stat.st_size}|{stat.st_mtime_ns}\n" for name, stat in facts)


def read_image_rgba(path: Path) -> UInt8[np.ndarray, "H W 4"]:
    """Decode an image, turned as its EXIF data asks; opaque where it has no alpha.

    Grey becomes RGB, 16 bit become 8. Raises UserError for what is damaged, cut short, floating
    point or of more than 67 million pixels.
    """
    if path.suffix.lower() == ".png":
        return read_png_rgba(path)
    try:
        content = read_file(path, MAX_IMAGE_BYTES)
    except DamagedFileError as error:
        raise UserError(f"{path} cannot be read: {error}.", "Check the file.") from None
    if content.startswith(PNG_START):  # Under another name.
        return decode_png_rgba(content, str(path))
    # Else a few MB of one colour would be decoded to gigabytes.
    require_bounded(header_size(content), str(path))
    if content.startswith(JPEG_START) and is_truncated_jpeg(content):
        raise UserError(
            f"{path} is truncated: the end of the picture is missing.",
            "Copy or export it again, or remove it.",
        )
    decoded, encoded = None, np.frombuffer(content, np.uint8)
    # OpenCV raises its own error for a few kinds of damage, and for sizes beyond its limit.
    with suppress(cv2.error):
        if path.suffix.lower() not in _NEVER_ALPHA:
            decoded = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
        if decoded is None or decoded.ndim == 2 or decoded.shape[2] != 4:
            # This way of reading drops alpha, but heeds the orientation that cameras note down.
            decoded = cv2.imdecode(encoded, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if decoded is None:
        raise UserError(f"{path} cannot be decoded as an image.", "Remove or replace it.")
    if decoded.dtype not in (np.uint8, np.uint16):
        raise UserError(
            f"{path} holds {decoded.dtype} values.", "Store images with 8 or 16 bits a channel."
        )
    turn = cv2.COLOR_BGRA2RGBA if decoded.shape[2] == 4 else cv2.COLOR_BGR2RGBA
    rgba = cv2.cvtColor(decoded, turn)
    if rgba.dtype == np.uint16:
        rgba = (rgba.astype(np.uint32) + 128) // 257
    return rgba.astype(np.uint8)


def fitted_size(width: int, height: int, max_side: int | None) -> tuple[int, int]:
    """The same shape with its longer side at most `max_side` pixels."""
    shrink = 1.0 if max_side is None else min(1.0, max_side / max(width, height))
    return max(1, round(width * shrink)), max(1, round(height * shrink))


def last_number(path: Path) -> int | None:
    """The last number in a file's name: 12 for cam1_frame_0012.png."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def _natural(text: str) -> list[tuple[int, str]]:
    parts = re.split(r"([0-9]+)", text)  # Every other one is a number.
    return [(int(part), "") if k % 2 else (-1, part) for k, part in enumerate(parts)]
