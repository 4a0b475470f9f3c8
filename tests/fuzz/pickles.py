"""Pickles and torch files built to take memory and time, or damaged: refused soon, or read."""

import io
import pickle
import struct
import tempfile
import time
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch

from rgbavatar_ns.data.importers.frame_files import parse_frame
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.torch_file import read_torch_file
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.safe_pickle import read_pickle
from tests.fuzz.attacks import Case, turned
from tests.head.synthetic_head import flame_shaped_arrays

NAME = "pickles"
MAX_SECONDS = 2.0
_SOUP = b"](}N)0K\1(ted2asuqR\x85\x86\x87b\x94h"
_ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\0tU\1btR"


def _part(value: object, protocol: int = 2) -> bytes:
    return pickle.dumps(value, protocol)[2:-1]


def _put(place: int) -> bytes:
    return b"r" + struct.pack("<I", place)


def _get(place: int) -> bytes:
    return b"j" + struct.pack("<I", place)


def _shared(part: bytes, times: int, place: int = 50_000) -> bytes:
    """A list of one thing many times."""
    return part + _put(place) + b"0](" + _get(place) * times + b"e"


def _doubling(opened: bytes, closed: bytes, levels: int, times: int, leaf: bytes) -> bytes:
    """Each level holds the one below it several times."""
    data = leaf
    for level in range(levels):
        place = 60_000 + level
        data += _put(place) + b"0" + opened + _get(place) * times + closed
    return data


def _dtype(name: bytes) -> bytes:
    return b"cnumpy\ndtype\n(" + name + b"K\0K\1tR"


def _array(shape: object, dtype: bytes, raw: bytes) -> bytes:
    return _ARRAY + b"(K\1" + _part(shape) + _dtype(dtype) + b"\x89" + raw + b"tb"


def _chumpy(name: bytes, state: bytes) -> bytes:
    return b"ccopy_reg\n_reconstructor\n(" + name + b"c__builtin__\nobject\nNtR}(" + state + b"ub"


def _sparse(shape: object, data: bytes, indices: bytes, indptr: bytes) -> bytes:
    return (
        b"ccopy_reg\n_reconstructor\n(cscipy.sparse.csc\ncsc_matrix\nc__builtin__\nobject\nNtR}("
        + b"U\6_shape" + _part(shape) + b"U\4data" + data + b"U\7indices" + indices
        + b"U\6indptr" + indptr + b"ub"
    )  # fmt: skip


def _greedy(generator: np.random.Generator) -> tuple[str, bytes]:
    """Opcodes that leave one value on the stack, which would take much if it were believed."""
    n = int(generator.integers(500, 4000))
    levels, times = int(generator.integers(3, 30)), int(generator.integers(2, 40))
    leaf = (b"G" + struct.pack(">d", 0.5), b"U\x01x", _part(np.ones(50)), b"N")
    leaf = leaf[int(generator.integers(len(leaf)))]
    text = b"X" + struct.pack("<I", n) + b"x" * n
    raw = b"U" + bytes([200]) + b"x" * 200
    u1 = _dtype(b"U\2u1")
    wide = _array((n,), b"U\2u1", text)
    made = {
        "lists of lists": _doubling(b"](", b"e", levels, times, leaf),
        "tuples of tuples": _doubling(b"(", b"t", levels, times, leaf),
        "dicts of lists": _doubling(b"}(K\0](", b"eu", levels, times, leaf),
        "one list often": _shared(b"](" + b"K\1" * n + b"e", n),
        "one text often": _shared(text, n),
        "one array often": _shared(wide, n),
        "one set often": _shared(b"\x8f(" + b"".join(_part(k) for k in range(n)) + b"\x90", n),
        "a text among numbers": b"](" + text * 20 + b"K\1" * n + b"e",
        "calls with many arguments": (
            b"(" + b"N" * n + b"t" + _put(1) + b"0]("
            + (b"cnumpy\ndtype\n" + _get(1) + b"R") * n + b"e"
        ),
        "states of many parts": (
            b"}(" + b"".join(_part(f"k{k}") + b"N" for k in range(n)) + b"u" + _put(1) + b"0]("
            + (b"cchumpy.ch\nCh\n)R" + _get(1) + b"b") * n + b"e"
        ),
        "the name of a number type": _dtype(_doubling(b"](", b"e", levels, times, leaf)),
        "bytes as a number type": b"](" + (text + _put(2) + b"0" + _dtype(_get(2))) * 9 + b"e",
        "chumpy of lists": _chumpy(
            b"cchumpy.ch\nCh\n", b"U\1x" + _doubling(b"](", b"e", levels, times, leaf)
        ),
        "chumpy that chooses often": _chumpy(
            b"cchumpy.reordering\nSelect\n",
            b"U\1a" + _array((2,), b"U\5S9999", b"X" + struct.pack("<I", 19998) + b"x" * 19998)
            + b"U\4idxs" + _part(np.zeros(n * 5, np.int64)),
        ),
        "wide sparse matrix": _sparse(
            (2**39, 1), _part(np.zeros(0)), _part(np.zeros(0, np.int32)), _part(np.zeros(2, int))
        ),
        "sparse matrices of shared parts": b"(" + _part(np.zeros(n)) + _put(1) + _part(
            np.zeros(n, np.int32)) + _put(2) + _part(np.array([0, n])) + _put(3) + b"1]("
            + _sparse((1, 1), _get(1), _get(2), _get(3)) * n + b"e",
        "rows without end": _array((2**39, 0), b"U\2f8", b"U\0"),
        "arrays of one raw": raw + _put(9) + b"0](" + _array((200,), b"U\2u1", _get(9)) * n + b"e",
        "array that claims": _array((2**39,), b"U\2f8", raw),
        "keys that hash alike": (
            b"}(" + b"".join(_part(k * (2**61 - 1)) + b"N" for k in range(1, n)) + b"u"
        ),
        "items that hash alike": (
            b"\x8f(" + b"".join(_part(k * (2**61 - 1)) for k in range(1, n)) + b"\x90"
        ),
        "long numbers": b"](" + (b"\x8a\xff" + bytes(254) + b"\1") * 50 + b"e",
        "itself": b"]" + _put(1) + _get(1) + b"a",
        "itself in a dict": b"}" + _put(1) + b"K\0(" + _get(1) + b"ts",
        "types": b"](" + (u1 + b"0" + u1) * 200 + b"e",
        "soup": bytes(generator.choice(list(_SOUP), n).tolist()),
    }  # fmt: skip
    name = str(generator.choice(sorted(made)))
    return name, made[name]


def _record() -> dict[str, object]:
    flame = {"exp": np.zeros((1, 100), np.float32), "shape": np.zeros((1, 300), np.float32)}
    flame["jaw"] = np.array([[1, 0, 0, 0, 1, 0]], np.float32)
    flame["eyes"] = np.tile(flame["jaw"], 2)
    opencv = {"R": np.eye(3)[None], "t": np.ones((1, 3)), "K": np.eye(3)[None]}
    return {"flame": flame, "opencv": opencv, "img_size": np.array([8, 8]), "x": torch.ones(2, 3)}


def _saved(as_zip: bool) -> bytes:
    file = io.BytesIO()
    torch.save(_record(), file, _use_new_zipfile_serialization=as_zip)
    return file.getvalue()


def _wrapped(value: bytes, place: str) -> bytes:
    """A pickle of a record with this value at a place of it, or of the value alone."""
    if not place:
        return b"\x80\x02" + value + b"."
    record = _record()
    del record["x"]
    group, key = place.split(".")
    record[group] = {**record[group], key: "@@"}  # pyright: ignore
    return pickle.dumps(record, 2).replace(_part("@@")[: -len(b"q\0")], value, 1)


def _in_torch_file(pickled: bytes, as_zip: bool) -> bytes:
    if as_zip:
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("a/data.pkl", pickled)
        return file.getvalue()
    heads = (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})
    return b"".join(pickle.dumps(head, 2) for head in heads) + pickled + pickle.dumps([], 2)


def cases(seed: int, count: int) -> Iterator[Case]:
    """Hostile values bare, in torch's files and within a tracker's record; and turned bits."""
    generator = np.random.default_rng(seed)
    arrays = flame_shaped_arrays()
    whole = {True: _saved(True), False: _saved(False)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "00001.frame"
        for _ in range(count):
            as_zip = bool(generator.integers(2))
            form = int(generator.integers(4))
            if form == 0:
                name, content = "turned bits", turned(whole[as_zip], generator, 8)
                name += " of a zip" if as_zip else ""
            else:
                name, value = _greedy(generator)
                place = str(generator.choice(["", "flame.exp", "flame.jaw", "opencv.K"]))
                content = _wrapped(value, place)
                name = f"{name} at {place}" if place else name
                content = _in_torch_file(content, as_zip) if form != 1 else content
            yield name, partial(_attack, path, content, form == 1, arrays, "of a zip" in name)


def _walk(value: object) -> None:
    """As whoever copies or prints it."""
    if isinstance(value, list | tuple | dict | set):
        for item in value.values() if isinstance(value, dict) else value:
            _walk(item)


def _attack(path: Path, content: bytes, bare: bool, arrays, is_checked: bool) -> None:
    path.write_bytes(content)
    begun = time.thread_time()
    try:
        value = read_pickle(path) if bare else read_torch_file(path)
        _walk(value)
        head = parse_frame(value, arrays)
        refusal = None
    except (UserError, UnusableFrameError) as error:
        head, refusal = None, error
    seconds = time.thread_time() - begun
    assert seconds < MAX_SECONDS, f"took {seconds:.1f} s"
    if refusal is not None:
        raise UserError(str(refusal), "") from None
    if head is not None:
        assert all(np.isfinite(part).all() for part in head.theta.values())
        if is_checked:
            same = parse_frame(_record(), arrays)
            assert all(np.array_equal(head.theta[name], same.theta[name]) for name in same.theta)
