"""Sizes from headers, against what Pillow says and what OpenCV decodes."""

import io
import struct
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from rgbavatar_ns.data.image_headers import header_size

_KINDS: dict[str, dict[str, Any]] = {
    "PNG": {"format": "PNG"},
    "JPEG": {"format": "JPEG"},
    "progressive JPEG": {"format": "JPEG", "progressive": True},
    "BMP": {"format": "BMP"},
    "lossy WebP": {"format": "WEBP"},
    "lossless WebP": {"format": "WEBP", "lossless": True},
    "WebP with metadata": {"format": "WEBP", "xmp": b"<x/>"},
    "TIFF": {"format": "TIFF"},
    "LZW TIFF": {"format": "TIFF", "compression": "tiff_lzw"},
}


def _encoded(kind: str, mode: str, size: tuple[int, int]) -> bytes:
    file = io.BytesIO()
    Image.new(mode, size).save(file, **_KINDS[kind])
    return file.getvalue()


@pytest.mark.parametrize("kind", _KINDS)
@pytest.mark.parametrize("size", [(1, 1), (300, 200), (257, 1031)])
def test_a_header_tells_the_size(kind, size):
    encoded = _encoded(kind, "RGB", size)
    assert header_size(encoded) == size
    assert cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR).shape[1::-1] == size


def test_kinds_with_alpha_of_the_other_byte_order_and_of_os2_too():
    assert header_size(_encoded("lossy WebP", "RGBA", (31, 17))) == (31, 17)
    tags = [(0x0100, 3, 300 << 16), (0x0101, 4, 70_000)]
    entries = b"".join(struct.pack(">HHII", tag, kind, 1, value) for tag, kind, value in tags)
    assert header_size(b"MM\0*" + struct.pack(">IH", 8, len(tags)) + entries) == (300, 70_000)
    os2 = struct.pack("<2sIHHIIHHHH", b"BM", 0, 0, 0, 26, 12, 5, 3, 1, 24) + bytes(3 * 16)
    assert header_size(os2) == (5, 3)
    assert cv2.imdecode(np.frombuffer(os2, np.uint8), cv2.IMREAD_COLOR).shape == (3, 5, 3)
    top_down = struct.pack("<2sIHHIIii", b"BM", 0, 0, 0, 54, 40, 5, -3) + bytes(80)
    assert header_size(top_down) == (5, 3)


@pytest.mark.parametrize("kind", _KINDS)
def test_a_header_cut_anywhere_is_no_error(kind):
    encoded = _encoded(kind, "RGB", (300, 200))
    for kept in range(min(len(encoded), 700)):
        assert header_size(encoded[:kept]) in (None, (300, 200))
    assert header_size(b"") is None
