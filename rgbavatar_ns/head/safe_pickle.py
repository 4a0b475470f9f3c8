"""Pickles and torch files of others, read as plain arrays: nothing in them is ever run.

FLAME's models and metrical-tracker's frames are pickles, which by design may call any function.
Here an opcode machine of our own builds numbers, texts, containers and arrays, and refuses every
name that is not on a short list, before anything of the size that it claims is made.
"""

import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.pickle_machine import (
    Budget,
    PickleGlobal,
    PickleMachine,
    RefusedPickleError,
    StandIn,
)
from rgbavatar_ns.head.pickle_values import ARRAY_GLOBALS, resolve, whole_numbers

MAX_FILE_BYTES = 512 * 2**20
"""FLAME's largest file has 53 MB, a tracker's frame 20 kB."""
_TORCH_MAGIC = 0x1950A86A20F9469CFC6C
_STORAGES = {
    "Double": np.float64,
    "Float": np.float32,
    "Half": np.float16,
    "Long": np.int64,
    "Int": np.int32,
    "Short": np.int16,
    "Char": np.int8,
    "Byte": np.uint8,
    "Bool": np.bool_,
}
_REMEDY = (
    "Get the file again from its maker; if it holds more than plain arrays, write those arrays "
    "to a file of their own first. Nothing in it was run."
)


def read_pickle(path: Path, max_bytes: int = MAX_FILE_BYTES) -> Any:
    """The plain containers and arrays in a pickle of any protocol, Python 2's included.

    numpy arrays and scipy.sparse matrices come as they are, chumpy arrays as numpy arrays.
    Raises UserError where the file is missing, longer than `max_bytes`, damaged, or asks for
    anything that is not on the list; arrays may take `max_bytes` of memory altogether.
    """
    path = Path(path)
    data = _read(path, max_bytes)

    def load() -> Any:
        budget = Budget(max_bytes)
        return resolve(PickleMachine(data, ARRAY_GLOBALS, budget).load(), budget)

    return _guarded(path, load)


def read_torch_file(path: Path, max_bytes: int = MAX_FILE_BYTES) -> Any:
    """What `torch.save` wrote, tensors as numpy arrays; the zip form and the older one.

    Holds containers of numpy arrays and of dense CPU tensors (metrical-tracker's `.frame`), under
    the rules of `read_pickle`. Compressed zip members are refused: torch writes none, and only
    they can unpack to more than the file holds.
    """
    path = Path(path)
    data = _read(path, max_bytes)
    load = _load_zip if data[:4] == b"PK\x03\x04" else _load_legacy
    return _guarded(path, lambda: load(data, Budget(max_bytes)))


def _read(path: Path, max_bytes: int) -> bytes:
    if not path.is_file():
        raise UserError(f"There is no file {path}.", "Name an existing file.")
    try:
        with path.open("rb") as file:
            data = file.read(min(max_bytes, path.stat().st_size) + 1)
    except OSError as error:
        raise UserError(
            f"{path} cannot be read: {error.strerror}.", "Name a file that you may read."
        ) from None
    if len(data) > max_bytes:
        raise UserError(
            f"{path} is longer than {max_bytes} bytes.", "Check that it is the right file."
        )
    return data


def _guarded(path: Path, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except RefusedPickleError as error:
        raise UserError(f"{path} was not read: {error}.", _REMEDY) from None
    except (
        ArithmeticError,
        EOFError,
        IndexError,
        KeyError,
        MemoryError,
        NotImplementedError,
        OSError,
        RecursionError,
        RuntimeError,
        TypeError,
        ValueError,
        struct.error,
        zipfile.BadZipFile,
    ) as error:
        raise UserError(
            f"{path} was not read: it is damaged ({type(error).__name__}).", _REMEDY
        ) from None


class _Storage(StandIn):
    """A torch storage: `count` numbers under a key, elsewhere in the file."""

    def __init__(self, persistent_id: Any) -> None:
        if not isinstance(persistent_id, tuple) or len(persistent_id) not in (5, 6):
            raise RefusedPickleError("it refers to data outside of it")
        what, kind, key, _, count = persistent_id[:5]
        if what != "storage" or not isinstance(kind, PickleGlobal) or not isinstance(key, str):
            raise RefusedPickleError("it refers to data outside of it")
        if len(persistent_id) == 6 and persistent_id[5] is not None:
            raise RefusedPickleError("it shares a part of a storage, as very old files do")
        name = kind.name.removeprefix("torch.").removesuffix("Storage")
        if name not in _STORAGES:
            raise RefusedPickleError(f"it takes {kind.name} for a kind of numbers")
        self.dtype = np.dtype(_STORAGES[name]).newbyteorder("<")
        self.key = key
        (self.count,) = whole_numbers(count)


class _Tensor(StandIn):
    """A dense torch tensor: a view of a storage."""

    def __init__(self, arguments: tuple[Any, ...]) -> None:
        storage, offset, size, stride = arguments[:4]
        if not isinstance(storage, _Storage):
            raise RefusedPickleError("it holds a tensor without a storage")
        self.storage = storage
        self.shape, self.stride = whole_numbers(size), whole_numbers(stride)
        (self.offset,) = whole_numbers(offset)
        last = sum((size - 1) * step for size, step in zip(self.shape, self.stride))
        empty = 0 in self.shape
        if len(self.shape) != len(self.stride) or (
            not empty and self.offset + last >= storage.count
        ):
            raise RefusedPickleError("it holds a tensor that reaches beyond its storage")

    def resolved(self, numbers: Shaped[np.ndarray, "n"], budget: Budget) -> Any:
        """A copy of its own, native byte order."""
        count = 1
        for size in self.shape:
            count *= size
        native = self.storage.dtype.newbyteorder("=")
        budget.spend(count * native.itemsize)
        if count == 0:
            return np.zeros(self.shape, native)
        steps = tuple(step * native.itemsize for step in self.stride)
        view = np.lib.stride_tricks.as_strided(numbers[self.offset :], self.shape, steps)
        return view.astype(native)


def _torch_globals() -> dict[str, PickleGlobal]:
    def refused(budget: Budget, arguments: tuple[Any, ...]) -> Any:
        raise RefusedPickleError("it makes a storage inside the pickle")

    makers = {
        "torch._utils._rebuild_tensor_v2": lambda budget, arguments: _Tensor(arguments),
        "torch._utils._rebuild_parameter": lambda budget, arguments: arguments[0],
        "torch.Size": lambda budget, arguments: whole_numbers(arguments[0]),
    }
    makers |= {f"torch.{name}Storage": refused for name in _STORAGES}
    return ARRAY_GLOBALS | {name: PickleGlobal(name, make) for name, make in makers.items()}


_TORCH_GLOBALS = _torch_globals()


def _load_zip(data: bytes, budget: Budget) -> Any:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {member.filename: member for member in archive.infolist()}
        pickles = [name for name in members if name.endswith("data.pkl")]
        if len(pickles) != 1:
            raise RefusedPickleError("it is a zip, but not one that torch.save wrote")
        folder = pickles[0].removesuffix("data.pkl")

        def member(name: str) -> bytes:
            info = members[folder + name]
            if info.compress_type != zipfile.ZIP_STORED or info.file_size > len(data):
                raise RefusedPickleError(f"its part {info.filename[:80]!r} is compressed")
            budget.spend(info.file_size)
            return archive.read(info)

        if folder + "byteorder" in members and member("byteorder") != b"little":
            raise RefusedPickleError("its numbers are stored in the other byte order")
        machine = PickleMachine(member("data.pkl"), _TORCH_GLOBALS, budget, _Storage)
        storages: dict[str, bytes] = {}

        def numbers(storage: _Storage) -> bytes:
            if storage.key not in storages:
                storages[storage.key] = member(f"data/{storage.key}")
            return storages[storage.key]

        return _resolve_tensors(machine.load(), budget, numbers)


def _load_legacy(data: bytes, budget: Budget) -> Any:
    """Magic number, version, platform, the value, its storages' keys; then their numbers."""
    named: dict[str, _Storage] = {}

    def storage(persistent_id: Any) -> _Storage:
        made = _Storage(persistent_id)
        return named.setdefault(made.key, made)

    machine = PickleMachine(data, _TORCH_GLOBALS, budget, storage)
    if machine.load() != _TORCH_MAGIC:
        raise RefusedPickleError("it is no file of torch.save")
    version, platform = machine.load(), machine.load()
    if version != 1001 or not isinstance(platform, dict) or not platform.get("little_endian"):
        raise RefusedPickleError("it is of an unknown version of torch.save")
    value, keys = machine.load(), machine.load()
    if not isinstance(keys, list) or set(keys) != set(named):
        raise RefusedPickleError("it does not name its storages")
    numbers: dict[str, bytes] = {}
    for key in keys:
        count = int.from_bytes(machine.take(8), "little")
        numbers[key] = machine.take(count * named[key].dtype.itemsize)
    return _resolve_tensors(value, budget, lambda storage: numbers[storage.key])


def _resolve_tensors(value: Any, budget: Budget, numbers: Callable[[_Storage], bytes]) -> Any:
    def other(part: Any) -> Any:
        if not isinstance(part, _Tensor):
            raise RefusedPickleError("it holds a storage that is no tensor")
        raw = numbers(part.storage)
        if len(raw) != part.storage.count * part.storage.dtype.itemsize:
            raise RefusedPickleError("a storage is not as long as it claims")
        return part.resolved(np.frombuffer(raw, part.storage.dtype), budget)

    return resolve(value, budget, other)
