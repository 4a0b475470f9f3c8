"""Files that others made: opened only if regular, of bounded size, and plain values come out.

Bytes of others can provoke nearly any error in zipfile, json and numpy; from here comes only
`DamagedFileError`, which says what is wrong. Who knows what the file is for names it and adds the
remedy.
"""

import io
import json
import math
import os
import re
import stat
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Shaped

MAX_INDEX_BYTES = 1 << 30
"""The largest index of frames; a long video's has some 10 MB."""
MAX_ARRAYS_BYTES = 1 << 29
"""All arrays of one file, unpacked; FLAME's take 130 MB."""
_MAX_DEPTH = 64
_MAX_DIGITS = 19
_MAX_MEMBERS = 4096
_MAX_DIRECTORY_BYTES = 1 << 20
_ZIP_END, _ZIP64_END, _ZIP_END_BYTES = b"PK\5\6", b"PK\6\6", 22
_LONGEST_COMMENT = 1 << 16
_MAX_UNPACKED_TIMES = 200
"""Arrays of real heads shrink to a fifth; deflate cannot do better than to a thousandth."""
_SMALL_BYTES = 16 << 20
"""What may unpack from anything: constant arrays shrink without limit."""
_PLAIN_KINDS = "biufcSU"
_LONG_NUMBER = re.compile("[0-9]{19}")
_LONE_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


class DamagedFileError(ValueError):
    """What is wrong with a file, in words that follow its name and a colon."""


class MissingFileError(DamagedFileError):
    """There is no such file."""


@contextmanager
def damage_told() -> Iterator[None]:
    """Whatever goes wrong within is told as DamagedFileError; only for reading bytes of others."""
    try:
        yield
    except DamagedFileError:
        raise
    except FileNotFoundError:
        raise MissingFileError("it does not exist") from None
    except OSError as error:
        raise DamagedFileError(error.strerror or str(error)) from None
    except MemoryError:
        raise DamagedFileError("it takes more memory than there is") from None
    except RecursionError:
        raise DamagedFileError("it is nested too deeply") from None
    except Exception as error:
        first_line = (str(error).splitlines() or [""])[0][:200]
        raise DamagedFileError(f"{type(error).__name__} {first_line}".strip()) from None


@contextmanager
def regular_file(path: Path) -> Iterator[BinaryIO]:
    """The file, opened to be read; DamagedFileError where it is none, unreadable or not regular."""
    with damage_told():
        # A FIFO without a writer would block here for ever.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise DamagedFileError("it is no regular file")
            yield file


def read_file(path: Path, max_bytes: int) -> bytes:
    """A regular file's content; raises DamagedFileError where it is none, unreadable or longer."""
    with regular_file(path) as file:
        too_long = DamagedFileError(f"it is longer than {max_bytes} bytes")
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            raise too_long
        content = file.read(size + 1)  # memory is taken for all of it at once
        if len(content) > size:
            raise DamagedFileError("it grows while it is read")
        return content


def parse_json(text: bytes | str) -> Any:
    """The value of a JSON text, a byte order mark allowed; raises DamagedFileError.

    Refuses what breaks those who use it later: numbers of more than 19 digits, nesting beyond 64
    and characters that are none. NaN and infinity pass, for one frame's must not cost the others.
    """
    with damage_told():
        if isinstance(text, bytes):
            text = text.decode("utf-8-sig")
        # A call for each number would cost most of the time.
        parse_int = _bounded_int if _LONG_NUMBER.search(text) else None
        value = json.loads(text, parse_int=parse_int)
        if _LONE_SURROGATE.search(text):
            json.dumps(value, ensure_ascii=False).encode()
        _check_depth(value)
        return value


def load_json(path: Path, max_bytes: int = MAX_INDEX_BYTES) -> Any:
    """`parse_json` of a file; raises DamagedFileError."""
    return parse_json(read_file(path, max_bytes))


def json_numbers(value: Any, shape: tuple[int, ...]) -> Shaped[np.ndarray, "..."]:
    """Numbers of a JSON value in nested lists of this shape, as float64.

    Raises DamagedFileError for another shape and for true, false, texts, NaN and whatever is beyond
    float32's reach.
    """
    flat: list[Any] = [value]
    for size in shape:
        if not all(isinstance(row, list) and len(row) == size for row in flat):
            raise DamagedFileError(f"it has not the shape {list(shape)}")
        flat = [item for row in flat for item in row]
    if not all(type(item) in (int, float) and abs(item) < 1e30 for item in flat):
        raise DamagedFileError("it has something else than finite numbers")
    return np.array(flat, dtype=np.float64).reshape(shape)


def load_array(path: Path, max_bytes: int = MAX_ARRAYS_BYTES) -> Shaped[np.ndarray, "..."]:
    """The array of an npy file, numbers or text; raises DamagedFileError."""
    return parse_array(read_file(path, max_bytes))


def load_arrays(
    path: Path, max_bytes: int = MAX_ARRAYS_BYTES, names: Collection[str] | None = None
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """The arrays of an npz file by name, `max_bytes` altogether; raises DamagedFileError.

    names: read those of them that there are, and nothing else of the file.
    """
    with regular_file(path) as file, open_archive(file) as archive:
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
        if names is not None:
            entries = {name: entries[name] for name in names if name in entries}
        claimed = sum(entry.file_size for entry in entries.values())
        packed = os.fstat(file.fileno()).st_size
        if claimed > min(max_bytes, _SMALL_BYTES + _MAX_UNPACKED_TIMES * packed):
            raise DamagedFileError(f"its arrays claim {claimed} bytes")
        return {name: parse_array(read_member(archive, e)) for name, e in entries.items()}


def parse_array(content: bytes) -> Shaped[np.ndarray, "..."]:
    """The array in an npy file's bytes, a copy of its own; raises DamagedFileError."""
    with damage_told():
        file = io.BytesIO(content)
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            header = np.lib.format.read_array_header_1_0(file)
        elif version == (2, 0):
            header = np.lib.format.read_array_header_2_0(file)
        else:
            raise DamagedFileError(f"it is npy of the unknown version {version}")
        shape, fortran, dtype = header
        if dtype.kind not in _PLAIN_KINDS or dtype.fields or dtype.subdtype:
            raise DamagedFileError(f"it holds {dtype}, not plain numbers or text")
        if not dtype.itemsize or not all(type(size) is int and size >= 0 for size in shape):
            raise DamagedFileError(f"it claims {dtype} of shape {shape}")
        body = content[file.tell() :]
        if math.prod(shape) * dtype.itemsize != len(body):
            raise DamagedFileError(f"it claims {dtype} of shape {shape} in {len(body)} bytes")
        flat = np.frombuffer(body, dtype) if body else np.zeros(math.prod(shape), dtype)
        return flat.reshape(shape, order="F" if fortran else "C").copy(order="K")


@contextmanager
def open_archive(file: BinaryIO | io.BytesIO) -> Iterator[zipfile.ZipFile]:
    """The zip in this file, of few members and none twice; raises DamagedFileError."""
    with damage_told():
        # A directory of millions takes long to read, so its end is looked at first.
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - 2 * _LONGEST_COMMENT))
        tail = file.read(2 * _LONGEST_COMMENT)
        uncommented = tail[-_ZIP_END_BYTES:]
        place = tail.rfind(_ZIP_END)
        if uncommented.startswith(_ZIP_END) and uncommented.endswith(b"\0\0"):
            place = len(tail) - len(uncommented)
        directory_bytes = int.from_bytes(tail[place + 12 : place + 16], "little")
        if tail[max(0, place - 76) :].startswith(_ZIP64_END):
            directory_bytes = int.from_bytes(tail[place - 36 : place - 28], "little")
        if place < 0 or directory_bytes > _MAX_DIRECTORY_BYTES:
            raise DamagedFileError("it is no zip, or one of too many members")
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()
            if len(names) > _MAX_MEMBERS or len(set(names)) < len(names):
                raise DamagedFileError("it has too many members, or two of one name")
            yield archive


def read_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """A member's bytes, no more than it claims, its checksum verified; DamagedFileError."""
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DamagedFileError(f"its member {entry.filename!a} is packed in an unusual way")
    if entry.flag_bits & 1:
        raise DamagedFileError(f"its member {entry.filename!a} is encrypted")
    with archive.open(entry) as member:
        content = member.read(entry.file_size)
    if len(content) != entry.file_size or zlib.crc32(content) != entry.CRC:
        raise DamagedFileError(f"its member {entry.filename!a} is damaged")
    return content


def _bounded_int(digits: str) -> int:
    if len(digits) > _MAX_DIGITS:
        raise DamagedFileError("it holds a number of too many digits")
    return int(digits)


def _check_depth(value: Any) -> None:
    level = [value]
    for _ in range(_MAX_DEPTH + 1):
        level = [
            child
            for item in level
            if isinstance(item, dict | list)
            for child in (item.values() if isinstance(item, dict) else item)
            if isinstance(child, dict | list)
        ]
        if not level:
            return
    raise DamagedFileError("it is nested too deeply")
