"""How a frame's RGBA image is made of a format's files: colour, matte and parsing masks."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from rgbavatar_ns.data.image_headers import jpeg_header
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.jpeg import JPEG_START, is_damaged_jpeg
from rgbavatar_ns.data.png import (
    MAX_IMAGE_BYTES,
    MAX_PIXELS,
    decode_bounded,
    decode_png_rgba,
    encode_png_rgba,
    png_damage,
    png_header_size,
)
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.reading import DamagedFileError, MissingFileError, read_file, regular_file

_GREY_TOLERANCE = 24
"""JPEG files of grey pictures come out a little coloured."""
_PNG_HEADER_BYTES, _JPEG_HEADER_BYTES = 33, 1 << 16
_NEARLY_WHITE = 250


@dataclass(frozen=True)
class FrameImage:
    """Files of one image, all of one size: colour, a matte (else colour's own alpha).

    A matte is grey, or a cut-out with alpha. It is kept only where one of the grey `regions` is
    white. `over_white`: whether the format lays its pictures over white by the matte, which is
    undone.
    """

    color: Path
    alpha: Path | None = None
    regions: tuple[Path, ...] = ()
    over_white: bool = False


@dataclass(frozen=True)
class ImageHeader:
    """What a file's first bytes say; width and height are those of the picture set upright."""

    width: int
    height: int
    has_alpha: bool


def image_header(path: Path) -> ImageHeader:
    """Size and kind from a file's first bytes; raises UnusableFrameError."""
    try:
        with regular_file(path) as file:
            head = file.read(_PNG_HEADER_BYTES)
            if head[:2] == JPEG_START:
                head += file.read(_JPEG_HEADER_BYTES)
                # A long colour profile or thumbnail may come first.
                found = jpeg_header(head) or jpeg_header(head + file.read(MAX_IMAGE_BYTES))
                size, has_alpha = (None if found is None else found[:2]), False
            else:
                # Colour types 4 and 6 are grey and RGB with alpha.
                size, has_alpha = png_header_size(head), head[25:26] in (b"\x04", b"\x06")
    except DamagedFileError as error:
        raise _unreadable(error) from None
    if not size or 0 in size:
        raise UnusableFrameError("images that are neither PNG nor JPEG, or damaged")
    return ImageHeader(*size, has_alpha)


@dataclass(frozen=True)
class EncodedImage:
    """A PNG; `is_original` where it is the very bytes of the colour's file."""

    encoded: bytes
    is_original: bool


def make_png(frame_image: FrameImage, size: tuple[int, int]) -> EncodedImage:
    """The frame image as an RGBA PNG of this (width, height); UnusableFrameError if it is not."""
    encoded = _read(frame_image.color)
    plain = frame_image.alpha is None and not frame_image.regions
    # Colour type 6 at depth 8 is RGBA of bytes.
    if plain and encoded[:4] == b"\x89PNG" and encoded[24:26] == b"\x08\x06":
        if png_damage(encoded) is not None:
            raise UnusableFrameError("images that are damaged or cut short")
        _require_size(png_header_size(encoded), size)
        return EncodedImage(encoded, True)
    image = _compose(frame_image, encoded, size)
    return EncodedImage(encode_png_rgba(image), False)


def _compose(
    frame_image: FrameImage, encoded: bytes, size: tuple[int, int]
) -> UInt8[np.ndarray, "height width 4"]:
    image = _decode(encoded, size)
    if frame_image.alpha is not None:
        image[..., 3] = _grey(frame_image.alpha, size)
    if frame_image.over_white:
        _take_off_white(image)
    if frame_image.regions:
        kept = np.maximum.reduce([_grey(path, size) for path in frame_image.regions])
        product = image[..., 3].astype(np.uint16) * kept
        image[..., 3] = ((product + 127) // 255).astype(np.uint8)
    return image


def _take_off_white(image: UInt8[np.ndarray, "height width 4"]) -> None:
    """Make straight colour, in place, of colour that its alpha has laid over white.

    A picture that is not white where its matte shows nothing was not laid over it, and stays.
    """
    alpha = image[..., 3]
    unseen, soft = alpha == 0, (alpha > 0) & (alpha < 255)
    if unseen.any() and np.median(image[unseen, :3]) < _NEARLY_WHITE:
        return
    share = image[soft, 3:].astype(np.float32) / 255
    straight = 255 - (255 - image[soft, :3].astype(np.float32)) / share
    image[soft, :3] = straight.round().clip(0, 255).astype(np.uint8)
    image[unseen, :3] = 0


def _read(path: Path) -> bytes:
    try:
        return read_file(path, MAX_IMAGE_BYTES)
    except DamagedFileError as error:
        raise _unreadable(error) from None


def _unreadable(error: DamagedFileError) -> UnusableFrameError:
    missing = isinstance(error, MissingFileError)
    return UnusableFrameError(f"images that {'are missing' if missing else 'cannot be read'}")


def _require_size(found: tuple[int, ...] | None, size: tuple[int, int]) -> None:
    if found is None or tuple(found) != size:
        raise UnusableFrameError("images whose parts differ in size")


def _decode(encoded: bytes, size: tuple[int, int]) -> UInt8[np.ndarray, "height width 4"]:
    """RGBA of a PNG of any kind or an RGB or grey JPEG of this (width, height).

    Raises UnusableFrameError, before any pixel is decoded where the header promises others.
    """
    is_jpeg = encoded[:2] == JPEG_START
    header = jpeg_header(encoded) if is_jpeg else png_header_size(encoded)
    if header is not None:
        if header[0] * header[1] > MAX_PIXELS:
            raise UnusableFrameError("images of more than 8192 x 8192 pixels")
        _require_size(header[:2], size)
    image = _decode_jpeg(encoded, header) if is_jpeg else _decode_png(encoded)
    _require_size(image.shape[1::-1], size)
    return image


def _decode_png(encoded: bytes) -> UInt8[np.ndarray, "height width 4"]:
    try:
        return decode_png_rgba(encoded, "")
    except UserError:
        raise UnusableFrameError("images that are damaged or cut short") from None


def _decode_jpeg(
    encoded: bytes, header: tuple[int, ...] | None
) -> UInt8[np.ndarray, "height width 4"]:
    if header is None or is_damaged_jpeg(encoded):
        raise UnusableFrameError("images that are damaged or cut short")
    if header[2] == 4:
        raise UnusableFrameError("CMYK JPEG images (convert them to RGB)")
    # As most trackers read it: turned as its EXIF orientation says.
    decoded = decode_bounded(encoded, cv2.IMREAD_COLOR, header[:2])
    if decoded is None:
        raise UnusableFrameError("images that are damaged or cut short")
    return cv2.cvtColor(decoded, cv2.COLOR_BGR2RGBA)


def _grey(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "height width"]:
    """A mask from 0 to 255; one that holds nothing but 0 and 1 is meant as 0 and 255.

    Where the picture is transparent anywhere its alpha is the mask: a cut-out's colours are none.
    """
    image = _decode(_read(path), size)
    color, alpha = image[..., :3], image[..., 3]
    if alpha.min() < 255:
        return alpha
    if int((color.max(-1) - color.min(-1)).max()) > _GREY_TOLERANCE:
        raise UnusableFrameError("masks that are coloured")
    grey = color[..., 1]
    return grey * np.uint8(255) if grey.max() == 1 else grey
