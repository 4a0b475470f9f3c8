"""Head models, UV maps and eyelids: damaged files, and whole ones that hold what no head is."""

import os
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rgbavatar_ns.head import HeadArrays, HeadModel
from rgbavatar_ns.head.arrays import embedded_file
from rgbavatar_ns.head.flame import _read_eyelid
from rgbavatar_ns.head.flame_uv import read_uv_map
from rgbavatar_ns.reading import load_arrays
from tests.fuzz.attacks import Case, harm
from tests.head.synthetic_head import flame_shaped_arrays, grid_faces

NAME = "heads"
_OBJ_LINES = ("f 1/1 2/2 3/3 4/4", "f 1 2 3", "f 9999999999999999999999/1 2/2 3/3", "vt nan 0.5",
              "vt 0.5", "f -1/-1 -2/-2 -3/-3", "vt 1e999 0", "f " + "1/1 " * 100_000, "v", "\0",
              "vt " + "0" * 5000 + " 0", "f 0/0 0/0 0/0", "vt 5 5")  # fmt: skip


def _wrong(value: np.ndarray, generator: np.random.Generator) -> tuple[str, np.ndarray]:
    """The array with other numbers, of another kind or another shape."""
    flat = value.astype(np.float64, copy=True) if value.dtype.kind in "iuf" else np.zeros(3)
    if flat.size:
        number = (np.nan, np.inf, -1.0, 1e30, 1e9, 2**40)[int(generator.integers(6))]
        flat.reshape(-1)[int(generator.integers(flat.size))] = number
    with np.errstate(all="ignore"):
        same_kind = flat.astype(value.dtype) if value.dtype.kind in "iuf" else value
    made = {
        "one number": same_kind,
        "text": np.full(value.shape, "x"),
        "complex": np.ones(value.shape, np.complex128),
        "booleans": np.ones(value.shape, bool),
        "bytes": np.ones(value.shape, np.uint8),
        "big end": value.astype(value.dtype.newbyteorder(">")),
        "long doubles": np.ones(value.shape, np.longdouble),
        "whole": np.ones(value.shape, np.int64),
        "unsigned": np.full(value.shape, 2**64 - 1, np.uint64),
        "none": np.zeros((0, *value.shape[1:]), value.dtype),
        "shorter": value[:-1] if value.ndim else value,
        "an axis more": value[None],
        "a scalar": np.array(1.0),
        "a wide text": np.array(["x" * 9999] * 3),
        "columns first": np.asfortranarray(value),
    }
    name = str(generator.choice(sorted(made)))
    return name, made[name]


def cases(seed: int, count: int) -> Iterator[Case]:
    """Damaged bytes, swapped arrays, and numbers that are wrong."""
    generator = np.random.default_rng(seed)
    faces = grid_faces(6)
    head = flame_shaped_arrays()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        head.save(folder / "head.npz")
        items = load_arrays(folder / "head.npz")
        for _ in range(count):
            kind = int(generator.integers(5))
            child = np.random.default_rng(int(generator.integers(2**60)))
            if kind < 2:
                yield ("head", partial(_head, folder, head, items, bool(kind), child))
            elif kind == 2:
                yield "UV npz", partial(_uv_npz, folder, head, child)
            elif kind == 3:
                yield "UV OBJ", partial(_uv_obj, folder, faces, child)
            else:
                yield "eyelid", partial(_eyelid, folder, child)


def _head(folder: Path, head: HeadArrays, items: dict[str, Any], swap: bool, generator) -> None:
    path = _fresh(folder / "h.npz")
    what = "nothing"
    if swap:
        name = str(generator.choice(sorted(items)))
        what, value = _wrong(items[name], generator)
        changed = {**items, name: value}
        if generator.integers(8) == 0:
            del changed[name]
        np.savez(path, **changed)
    else:
        path.write_bytes((folder / "head.npz").read_bytes())
        harm(path, generator, is_checked=True)
    read = HeadArrays.load(path)
    HeadModel(read)
    if not swap:
        assert read.digest() == head.digest(), "read another head"
    for name, value in vars(read).items():
        if isinstance(value, np.ndarray):
            assert np.isfinite(value).all(), f"{name} of {what} is not finite"
            assert value.dtype.kind in "if", f"{name} is {value.dtype}"


def _uv_npz(folder: Path, head: HeadArrays, generator) -> None:
    path = _fresh(folder / "uv.npz")
    whole = {"vt": head.uv, "ft": head.uv_faces}
    swap = bool(generator.integers(2))
    if swap:
        name = ("vt", "ft")[int(generator.integers(2))]
        whole[name] = _wrong(whole[name], generator)[1]
    np.savez(path, **whole)
    if not swap:
        harm(path, generator, is_checked=True)
    uv, uv_faces = read_uv_map(path, head.faces)
    _require_map(uv, uv_faces)
    if not swap:
        assert np.array_equal(uv, head.uv), "read another map"


def _uv_obj(folder: Path, faces: np.ndarray, generator) -> None:
    path = _fresh(folder / "uv.obj")
    lines = [f"vt {k / 36} {k / 40}" for k in range(36)]
    lines += ["f " + " ".join(f"{n + 1}/{n + 1}" for n in face) for face in faces]
    for _ in range(int(generator.integers(3))):
        place = int(generator.integers(len(lines)))
        lines[place] = _OBJ_LINES[int(generator.integers(len(_OBJ_LINES)))]
    path.write_text("\n".join(lines))
    if generator.integers(3) == 0:
        harm(path, generator)
    _require_map(*read_uv_map(path, faces))


def _eyelid(folder: Path, generator) -> None:
    path = _fresh(folder / "l_eyelid.npy")
    offsets = np.zeros((5023, 3), np.float32)
    np.save(path, _wrong(offsets, generator)[1] if generator.integers(2) else offsets)
    kind = int(generator.integers(4))
    if kind == 0:
        harm(path, generator)
    elif kind == 1:
        path.write_bytes(embedded_file().read_bytes()[:10_000])
    elif kind == 2:
        shape = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}\n"
        path.write_bytes(b"\x93NUMPY\1\0" + len(shape).to_bytes(2, "little") + shape)
    read = _read_eyelid(path)
    assert read.shape == (5023, 3)
    if not np.isfinite(read).all():
        raise AssertionError("an eyelid is not finite")


def _require_map(uv: np.ndarray, uv_faces: np.ndarray) -> None:
    assert uv.min() >= 0
    assert uv.max() <= 1
    assert 0 <= uv_faces.min() <= uv_faces.max() < len(uv)


def _fresh(path: Path) -> Path:
    if path.is_dir():
        path.rmdir()
    elif os.path.lexists(path):
        path.unlink()
    return path
