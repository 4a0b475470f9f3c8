"""What an image file's first bytes say of it, before a pixel is decoded."""

import struct

from rgbavatar_ns.data.jpeg import JPEG_START
from rgbavatar_ns.data.png import png_header_size

_WIDTH, _HEIGHT, _ORIENTATION = 0x0100, 0x0101, 0x0112
_LONG = 4
"""TIFF's number for values of four bytes; the smaller ones here have two."""
_OS2_HEADER_BYTES = 12
_ON_ITS_SIDE = range(5, 9)
"""EXIF's orientations of pictures whose stored width is their height."""


def header_size(encoded: bytes) -> tuple[int, int] | None:
    """(width, height) that a PNG, JPEG, TIFF, WebP or BMP promises; None where that is not told.

    Of a TIFF the first page's, as it is stored.
    """
    if encoded[:2] == JPEG_START:
        found = jpeg_header(encoded)
        return None if found is None else found[:2]
    if encoded[:4] in _TIFF_ORDERS:
        tags = _tiff_tags(encoded)
        return (tags[_WIDTH], tags[_HEIGHT]) if {_WIDTH, _HEIGHT} <= tags.keys() else None
    try:
        if encoded[:4] == b"RIFF" and encoded[8:12] == b"WEBP":
            return _webp_size(encoded)
        if encoded[:2] == b"BM":
            header_bytes, width, height = struct.unpack_from("<Iii", encoded, 14)
            # A negative height is of rows from the top. OS/2's sides have two bytes.
            old = header_bytes == _OS2_HEADER_BYTES
            return struct.unpack_from("<HH", encoded, 18) if old else (abs(width), abs(height))
    except struct.error:  # It ends before what it promises.
        return None
    return png_header_size(encoded)


def _webp_size(encoded: bytes) -> tuple[int, int] | None:
    """Source: RFC 9649, sections 2.5 to 2.7."""
    kind = encoded[12:16]
    if kind == b"VP8X":
        low, high = struct.unpack_from("<IH", encoded, 24)
        return (low & 0xFFFFFF) + 1, ((low >> 24) | (high << 8)) + 1
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", encoded, 21)
        return (bits & 0x3FFF) + 1, ((bits >> 14) & 0x3FFF) + 1
    width, height = struct.unpack_from("<HH", encoded, 26)
    return width & 0x3FFF, height & 0x3FFF


def jpeg_header(encoded: bytes) -> tuple[int, int, int] | None:
    """(width, height, components) from a JPEG's frame header; None where there is none.

    The sides are those of the picture as OpenCV sets it upright by its EXIF data.
    """
    place, lies_on_its_side = 2, False
    while place + 9 < len(encoded) and encoded[place] == 0xFF:
        marker = encoded[place + 1]
        if marker == 0xFF:  # fill bytes
            place += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width, components = struct.unpack(">HHB", encoded[place + 5 : place + 10])
            sides = (height, width) if lies_on_its_side else (width, height)
            return *sides, components
        end = place + 2 + struct.unpack(">H", encoded[place + 2 : place + 4])[0]
        if marker == 0xE1 and encoded[place + 4 : place + 10] == b"Exif\0\0":
            # EXIF data has TIFF's form; 1 is upright.
            orientation = _tiff_tags(encoded[place + 10 : end]).get(_ORIENTATION, 1)
            lies_on_its_side = orientation in _ON_ITS_SIDE
        place = end
    return None


_TIFF_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}


def _tiff_tags(block: bytes) -> dict[int, int]:
    """Numbers of a TIFF's first directory by their tags, as far as it goes.

    Source: TIFF 6.0, sections 2 and 8.
    """
    tags: dict[int, int] = {}
    order = _TIFF_ORDERS.get(block[:4])
    if order is None:
        return tags
    try:
        (place,) = struct.unpack_from(f"{order}I", block, 4)
        (count,) = struct.unpack_from(f"{order}H", block, place)
        for entry in range(count):
            at = place + 2 + 12 * entry
            tag, kind = struct.unpack_from(f"{order}HH", block, at)
            form = "I" if kind == _LONG else "H"
            (value,) = struct.unpack_from(f"{order}{form}", block, at + 8)
            tags.setdefault(tag, value)
    except struct.error:  # It ends before what it promises.
        pass
    return tags
