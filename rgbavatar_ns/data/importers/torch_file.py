"""What `torch.save` wrote, as numpy arrays: nothing in it is run.

`torch.load(weights_only=True)` does not suffice: it unpacks compressed members of any size, makes
`bytearray(2**40)`, doubles bytes by `_codecs.encode(..., "hex")` as often as it is told, and lacks
numpy's arrays, of which a tracker's frames consist. So the pickle within is read as FLAME's is.
"""

import io
import zipfile
from collections.abc import Callable
from functools import cache
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from rgbavatar_ns.head.safe_pickle import (
    ARRAY_NAMES,
    MAX_FILE_BYTES,
    RefusedPickleError,
    Resolver,
    StandIn,
    refusals_told,
    stand_in,
    unpickle,
    whole_numbers,
)
from rgbavatar_ns.reading import open_archive, read_file, read_member

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_NUMBERS = {
    "Double": "<f8",
    "Float": "<f4",
    "Half": "<f2",
    "Long": "<i8",
    "Int": "<i4",
    "Short": "<i2",
    "Char": "i1",
    "Byte": "u1",
    "Bool": "?",
}


def read_torch_file(path: Path, max_bytes: int = MAX_FILE_BYTES) -> Any:
    """Containers, numpy arrays and dense CPU tensors of torch's zip form or the older one.

    Under the rules of `head.safe_pickle.read_pickle`. Compressed zip members, which can unpack to
    more than the file holds, are refused.
    """
    with refusals_told(path):
        data = read_file(path, max_bytes)
        load = _load_zip if data.startswith(b"PK\x03\x04") else _load_legacy
        return load(data, Resolver(data, max_bytes))


def _load_zip(data: bytes, resolve: Resolver) -> Any:
    with open_archive(io.BytesIO(data)) as archive:
        members = {member.filename: member for member in archive.infolist()}
        pickles = [name for name in members if name.endswith("data.pkl")]
        if len(pickles) != 1:
            raise RefusedPickleError("it is a zip, but not one that torch.save wrote")
        folder = pickles[0].removesuffix("data.pkl")

        @cache
        def member(name: str) -> bytes:
            info = members[folder + name]
            if info.compress_type != zipfile.ZIP_STORED or info.file_size > len(data):
                raise RefusedPickleError(f"its part {info.filename[:80]!r} is compressed")
            resolve.spend(info.file_size)
            return read_member(archive, info)

        if folder + "byteorder" in members and member("byteorder") != b"little":
            raise RefusedPickleError("its numbers are stored in the other byte order")
        storage = _storage_maker(lambda key: member(f"data/{key}"), {})
        return resolve(unpickle(io.BytesIO(member("data.pkl")), _TORCH_NAMES, storage))


def _load_legacy(data: bytes, resolve: Resolver) -> Any:
    """Magic number, version, platform, the value, its storages' keys; then their numbers."""
    file = io.BytesIO(data)
    sizes: dict[str, int] = {}
    raw: dict[str, bytes] = {}
    storage = _storage_maker(raw.__getitem__, sizes)
    if unpickle(file, {}) != _LEGACY_MAGIC:
        raise RefusedPickleError("it is no file of torch.save")
    version, platform = unpickle(file, {}), unpickle(file, {})
    if version != 1001 or not isinstance(platform, dict) or not platform.get("little_endian"):
        raise RefusedPickleError("it is of an unknown version of torch.save")
    value, keys = unpickle(file, _TORCH_NAMES, storage), unpickle(file, {})
    if not isinstance(keys, list) or set(keys) != sizes.keys():
        raise RefusedPickleError("it does not name its storages")
    for key in keys:
        # Before its bytes stands a storage's count of numbers, which the pickle tells too.
        raw[key] = file.read(8 + sizes[key])[8:]
    return resolve(value)


def _storage_maker(read: Callable[[str], bytes], sizes: dict[str, int]) -> Callable[..., StandIn]:
    """Makes stand-ins for storages of persistent ids; notes their bytes in `sizes`, by key."""

    def numbers(made: StandIn, resolve: Resolver) -> Shaped[np.ndarray, "n"]:
        key, dtype, count = made.arguments
        raw = read(key)
        if len(raw) != count * dtype.itemsize:
            raise RefusedPickleError("a storage is not as long as it claims")
        return np.frombuffer(raw, dtype)

    storage = stand_in(_STORAGE, numbers)

    def make(persistent_id: Any) -> StandIn:
        what, kind, key, _, count, *view = persistent_id
        if what != "storage" or not isinstance(kind, type) or not isinstance(key, str):
            raise RefusedPickleError("it refers to data outside of it")
        if view not in ([], [None]):
            raise RefusedPickleError("it shares a part of a storage, as very old files do")
        name = kind.name.removeprefix("torch.").removesuffix("Storage")
        if name not in _NUMBERS:
            raise RefusedPickleError(f"it takes {kind.name} for a kind of numbers")
        (count,), dtype = whole_numbers(count), np.dtype(_NUMBERS[name])
        sizes.setdefault(key, count * dtype.itemsize)
        return storage(key, dtype, count)

    return make


_STORAGE = "torch storage"


def _tensor(made: StandIn, resolve: Resolver) -> Shaped[np.ndarray, "..."]:
    """A dense torch tensor, a view of a storage, as a copy of its own in native byte order."""
    storage, offset, size, stride = made.arguments[:4]
    if not isinstance(storage, StandIn) or storage.name != _STORAGE:
        raise RefusedPickleError("it holds a tensor without a storage")
    numbers = resolve(storage)
    shape, steps = whole_numbers(resolve(size)), whole_numbers(resolve(stride))
    (offset,) = whole_numbers(offset)
    last = offset + sum((size - 1) * step for size, step in zip(shape, steps))
    if len(shape) != len(steps) or (0 not in shape and last >= len(numbers)):
        raise RefusedPickleError("it holds a tensor that reaches beyond its storage")
    native = numbers.dtype.newbyteorder("=")
    resolve.spend(max(prod(shape) * native.itemsize, *shape, 0))
    if 0 in shape:
        return np.zeros(shape, native)
    strides = tuple(step * native.itemsize for step in steps)
    return np.lib.stride_tricks.as_strided(numbers[offset:], shape, strides).astype(native)


def _parameter(made: StandIn, resolve: Resolver) -> Shaped[np.ndarray, "..."]:
    value = resolve(made.arguments[0])
    if not isinstance(value, np.ndarray):
        raise RefusedPickleError("it holds a parameter that is no tensor")
    return value


def _no_value(made: StandIn, resolve: Resolver) -> Any:
    raise RefusedPickleError(f"it makes a {made.name} that stands for nothing")


_TORCH_NAMES = ARRAY_NAMES | {
    name: stand_in(name, convert)
    for name, convert in {
        "torch._utils._rebuild_tensor_v2": _tensor,
        "torch._utils._rebuild_parameter": _parameter,
        "torch.Size": lambda made, resolve: whole_numbers(resolve(made.arguments[0])),
        # A tensor's hooks, which nobody here asks for.
        "collections.OrderedDict": _no_value,
        **{f"torch.{name}Storage": _no_value for name in _NUMBERS},
    }.items()
}
