"""JPEG files: whether they are whole, which OpenCV does not tell of all of them."""

import re

import av
import av.error

JPEG_START = b"\xff\xd8"
# ITU-T T.81, B.1: 00 and further FF are no marker's; restarts (D0 to D7) are within a picture.
_MARKER = re.compile(rb"\xff([\x01-\xcf\xd8-\xfe])")
_END, _ALONE = 0xD9, (0x01, 0xD8)


def is_truncated_jpeg(encoded: bytes) -> bool:
    """Whether a JPEG is cut short; OpenCV makes the rest of such a picture grey.

    Bytes may follow the end, and only the end's marker may lack: some cameras leave it out.
    """
    if _has_end(encoded):
        return False
    # What a broken copy leaves to be filled is zeros, which are codes to a decoder.
    return encoded.endswith(b"\0\0") or _ffmpeg_decodes(encoded) is not True


def is_damaged_jpeg(encoded: bytes) -> bool:
    """Whether a JPEG is cut short, or its bits are no code of it; the others' change is not seen.

    Without the end's marker it is: who exports datasets writes that.
    OpenCV decodes those too, and tells on stderr at most; ffmpeg's decoder can be told to refuse.
    JPEG has no checksums: most turned bits still are a picture, and nothing tells them.
    """
    return not _has_end(encoded) or _ffmpeg_decodes(encoded) is False


def _has_end(encoded: bytes) -> bool:
    """Whether the picture's own end is there; that of a thumbnail within it is passed over."""
    place = len(JPEG_START)
    while (marker := _MARKER.search(encoded, place)) is not None:
        kind, place = marker[1][0], marker.end()
        if kind == _END:
            return True
        if kind not in _ALONE:
            place += int.from_bytes(encoded[place : place + 2], "big")
    return False


def _ffmpeg_decodes(encoded: bytes) -> bool | None:
    """Whether ffmpeg finds no fault; None for a rarer kind of JPEG, which OpenCV may know."""
    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode"}
    try:
        return bool(decoder.decode(av.Packet(encoded)))
    except av.error.InvalidDataError:
        return False
    except av.error.FFmpegError:
        return None
