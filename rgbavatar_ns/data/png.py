"""PNG files as they are: RGBA with straight alpha, and every damage is told."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.reading import DamagedFileError, MissingFileError, read_file, regular_file

PNG_START = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 33
MAX_IMAGE_BYTES, MAX_PIXELS = 1 << 28, 1 << 26
"""What is read of one image: 8192 x 8192 pixels take 256 MB."""
_END_CHUNK = b"\x00\x00\x00\x00IEND\xaeB`\x82"
# Runs alone: images with much that is empty come out a tenth to a fifth smaller than with the
# default search for repeats at level 1 or 3, in the time that level 1 takes.
_ENCODING = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
_REPAIR = "Copy or export the file again, or leave the frame out of the dataset."


def png_size(path: Path) -> tuple[int, int]:
    """(width, height) from a PNG's first bytes; UserError where it is none, or cut short."""
    with _file_errors(path), regular_file(path) as file:
        head = file.read(_HEADER_BYTES)
        end = file.seek(0, 2)
        file.seek(max(0, end - len(_END_CHUNK)))
        tail = file.read()
    if not head:
        raise UserError(f"The image {path} is empty.", _REPAIR)
    if head[:8] != PNG_START[: len(head)] or head[12:16] != b"IHDR"[: max(0, len(head) - 12)]:
        raise UserError(f"{path} is not a PNG image.", "Store images as PNG files.")
    size = png_header_size(head)
    if size is None or tail != _END_CHUNK:
        raise UserError(f"The image {path} is truncated.", _REPAIR)
    return size


def png_header_size(encoded: bytes) -> tuple[int, int] | None:
    """(width, height) that a PNG's first bytes promise; None where they are none of a PNG."""
    if len(encoded) < _HEADER_BYTES or encoded[:8] != PNG_START or encoded[12:16] != b"IHDR":
        return None
    width, height = struct.unpack(">II", encoded[16:24])
    return width, height


@contextmanager
def _file_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except MissingFileError:
        raise UserError(f"The image {path} is missing.", _REPAIR) from None
    except DamagedFileError as error:
        raise UserError(f"The image {path} cannot be read: {error}.", _REPAIR) from None


def read_png_rgba(path: Path) -> UInt8[np.ndarray, "height width 4"]:
    """Decode a PNG file to RGBA, see `decode_png_rgba`; raises UserError naming the file."""
    with _file_errors(path):
        encoded = read_file(path, MAX_IMAGE_BYTES)
    return decode_png_rgba(encoded, str(path))


def decode_png_rgba(encoded: bytes, name: str) -> UInt8[np.ndarray, "height width 4"]:
    """Decode a PNG to RGBA; grey becomes RGB, a missing alpha becomes opaque.

    Raises UserError, calling the image `name`, where it is too large, or a chunk's length or
    checksum is wrong: OpenCV alone would hand back a partial picture without a word.
    """
    damage = png_damage(encoded)
    if damage is not None:
        raise UserError(f"The image {name} {damage}.", _REPAIR)
    size = png_header_size(encoded)
    require_bounded(size, name)
    decoded = decode_bounded(encoded, cv2.IMREAD_UNCHANGED, size)
    if decoded is None:
        raise UserError(f"The image {name} cannot be decoded.", _REPAIR)
    if decoded.dtype == np.uint16:
        decoded = ((decoded.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if decoded.ndim == 2:
        return cv2.cvtColor(decoded, cv2.COLOR_GRAY2RGBA)
    opaque = decoded.shape[2] == 3
    return cv2.cvtColor(decoded, cv2.COLOR_BGR2RGBA if opaque else cv2.COLOR_BGRA2RGBA)


def require_bounded(size: tuple[int, int] | None, name: str) -> None:
    """Raise UserError, calling the image `name`, where its header promises more than is read."""
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise UserError(
            f"The image {name} is said to have {size[0]} x {size[1]} pixels.",
            f"Make it smaller: images of up to {MAX_PIXELS / 1e6:.0f} million pixels are read.",
        )


def decode_bounded(
    encoded: bytes, flags: int, size: tuple[int, ...] | None
) -> UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."] | None:
    """OpenCV's picture, given the size that its header promises; None for none, or a huge one."""
    if size is None or not 0 < size[0] * size[1] <= MAX_PIXELS:
        return None
    try:
        return cv2.imdecode(np.frombuffer(encoded, np.uint8), flags)
    except cv2.error:
        return None


def encode_png_rgba(image_rgba: UInt8[np.ndarray, "height width 4"]) -> bytes:
    """Encode straight-alpha RGBA as a PNG; lossless, colour under zero alpha included."""
    bgra = cv2.cvtColor(np.ascontiguousarray(image_rgba), cv2.COLOR_RGBA2BGRA)
    ok, encoded = cv2.imencode(".png", bgra, _ENCODING)
    if not ok:
        raise RuntimeError(f"OpenCV could not encode an image of {image_rgba.shape}.")
    return encoded.tobytes()


def png_damage(encoded: bytes) -> str | None:
    """Say what is wrong with a PNG's chunks, or None where they are whole."""
    if not encoded:
        return "is empty"
    if encoded[:8] != PNG_START[: len(encoded)]:
        return "is not a PNG"
    place, size = 8, len(encoded)
    while place + 12 <= size:
        (length,) = struct.unpack(">I", encoded[place : place + 4])
        end = place + 12 + length
        if end > size:
            break
        kind_and_data = memoryview(encoded)[place + 4 : end - 4]
        (checksum,) = struct.unpack(">I", encoded[end - 4 : end])
        if zlib.crc32(kind_and_data) != checksum:
            return "is damaged (a checksum is wrong)"
        if kind_and_data[:4] == b"IEND":
            return None
        place = end
    return "is truncated"
