"""Pickles of others, read as plain arrays: nothing in them is ever run.

Python's own `pickle.Unpickler` reads them, but its `find_class` gives inert stand-ins for the few
names that arrays need and refuses every other. A stand-in only holds what it is given; `Resolver`
makes the arrays in the end. What the Unpickler could not refuse alone, `_vet` refuses first.
"""

import io
import pickle
import pickletools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import scipy.sparse
from jaxtyping import Shaped

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.reading import DamagedFileError, read_file

MAX_FILE_BYTES = 512 * 2**20
"""FLAME's largest file has 53 MB, a tracker's frame 20 kB."""
MAX_OPCODES = 200_000
"""Model files need thousands; this many take half a second and 50 MB at most."""
_MAX_NUMBER_BITS, _MAX_KEY_BITS, _MAX_DIMENSIONS, _MAX_DEPTH = 512, 60, 32, 50
_MAX_PARTS = 64
"""Of one object's arguments or state; a sparse matrix has ten."""
_SMALL_BYTES, _UNFOLDED_TIMES = 4 * 2**20, 8
"""What may come of any file, and of a longer one for each byte: sharing makes much of little."""
_NODE_BYTES = 8
_UNUSED = ("EXT1", "EXT2", "EXT4", "INST", "OBJ", "NEWOBJ_EX", "NEXT_BUFFER", "READONLY_BUFFER")
_LONG_NUMBER = pickletools.StackObject("long number", int, "Numbers can be made that hash alike.")
_PLAIN = {"str", "bytes", "bytes_or_str", "int", "int_or_bool", "bool", "float", "None"}
"""What pickletools calls the types that may be keys."""
_KEYED = ("SETITEM", "SETITEMS", "DICT", "ADDITEMS", "FROZENSET")
_MARK = pickletools.markobject
_OPCODES = {opcode.code.encode("latin-1"): opcode for opcode in pickletools.opcodes}
_DTYPE = re.compile(r"[<>=|]?(\?|[bBhHiIlLqQefdFD]|b1|[iu][1248]|f[248]|c8|c16|[SU]\d{1,4})")
_REMEDY = (
    "Get the file again from its maker; if it holds more than plain arrays, write those arrays "
    "to a file of their own first. Nothing in it was run."
)


class RefusedPickleError(DamagedFileError):
    """A pickle that is damaged or asks for something that is not on the list."""


def read_pickle(path: Path, max_bytes: int = MAX_FILE_BYTES) -> Any:
    """The plain containers and arrays in a pickle of any protocol, Python 2's included.

    numpy arrays and scipy.sparse matrices come as they are, chumpy arrays as numpy arrays.
    Raises UserError where the file is missing, longer than `max_bytes`, damaged, or asks for
    anything that is not on the list. Arrays, and the whole value unfolded as a tree, may take some
    times the file's size, and `max_bytes` at most.
    """
    with refusals_told(path):
        content = read_file(path, max_bytes)
        return Resolver(content, max_bytes)(unpickle(io.BytesIO(content), ARRAY_NAMES))


@contextmanager
def refusals_told(path: Path) -> Iterator[None]:
    """Whatever goes wrong within becomes a UserError about this file."""
    try:
        yield
    except Exception as error:
        # Bytes of others can provoke nearly any error in pickle, zipfile, numpy and scipy.
        refused = isinstance(error, DamagedFileError)
        why = error if refused else f"it is damaged ({type(error).__name__})"
        raise UserError(f"{path} was not read: {why}.", _REMEDY) from None


class StandIn:
    """What a name in a pickle becomes: calling it makes a holder of the arguments.

    It takes a state as the real class would, cannot be a key, and runs nothing.
    """

    __slots__ = ("arguments", "state")
    __hash__ = None  # pyright: ignore[reportAssignmentType]
    name: ClassVar[str]
    convert: ClassVar["Convert"]

    def __new__(cls, *arguments: Any) -> "StandIn":
        """Not `__init__`, which pickle may pass over."""
        _require_few(arguments)
        made = super().__new__(cls)
        made.arguments, made.state = arguments, None
        return made

    def __setstate__(self, state: Any) -> None:
        _require_few(state)
        self.state = state


def _require_few(parts: Any) -> None:
    if isinstance(parts, tuple | list | dict) and len(parts) > _MAX_PARTS:
        raise RefusedPickleError(f"it makes an object of more than {_MAX_PARTS} parts")


Convert = Callable[[Any, "Resolver"], Any]
"""From a StandIn, whose parts are not yet resolved, to its value."""


def stand_in(name: str, convert: Convert) -> type[StandIn]:
    """The stand-in for a name."""
    return type(name, (StandIn,), {"__slots__": (), "name": name, "convert": convert})


def unpickle(
    file: io.BytesIO,
    names: Mapping[str, type[StandIn]],
    persistent_load: Callable[[Any], StandIn] | None = None,
    max_opcodes: int = MAX_OPCODES,
) -> Any:
    """The next pickle in the file, its stand-ins not yet resolved.

    persistent_load: makes a stand-in of a persistent id; None refuses them. Raises
    RefusedPickleError, and where the file is damaged whatever Python raises.
    """
    start = file.tell()
    _vet(file, max_opcodes)
    end = file.tell()
    file.seek(start)
    value = _Unpickler(file, names, persistent_load).load()
    file.seek(end)
    return value


class _Unpickler(pickle.Unpickler):
    def __init__(
        self,
        file: io.BytesIO,
        names: Mapping[str, type[StandIn]],
        persistent: Callable[[Any], StandIn] | None,
    ) -> None:
        super().__init__(file, encoding="latin1")  # Python 2's text: one character a byte
        self._names = names
        self._persistent = persistent

    def find_class(self, module: str, name: str, /) -> type[StandIn]:
        full = f"{module}.{name}"
        if full not in self._names:
            raise RefusedPickleError(f"it asks for {full[:120]!a}, which is not on the list")
        return self._names[full]

    def persistent_load(self, pid: Any, /) -> StandIn:
        if self._persistent is None:
            raise RefusedPickleError("it refers to data outside of it")
        return self._persistent(pid)


def _vet(file: io.BytesIO, max_opcodes: int) -> None:
    """Refuse in one pickle's opcodes what the Unpickler alone could not.

    That is: lengths beyond the file's end and high memo numbers, for which it takes memory at once;
    numbers of a million digits; steps without end; classes that others registered (EXT); and, as
    the types on the stack tell, tuples and long numbers as keys: a few nested ones, or many that
    hash alike, can take for ever.
    """
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for opcode, argument in _opcodes(file, max_opcodes):
        name, before, after = opcode.name, opcode.stack_before, opcode.stack_after
        if name in _UNUSED:
            raise RefusedPickleError(f"it holds the opcode {name}, not needed here")
        if isinstance(argument, int) and argument.bit_length() > _MAX_NUMBER_BITS:
            raise RefusedPickleError("it holds a number of too many digits")
        if after and isinstance(argument, int) and argument.bit_length() > _MAX_KEY_BITS:
            after = [_LONG_NUMBER]
        if "PUT" in name:
            if argument > max_opcodes:
                raise RefusedPickleError(f"it remembers more than {max_opcodes} values")
            memo[argument] = stack[-1]
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
            after = stack[-1:]
        elif "GET" in name:
            after = [memo[argument]]
        items: list[Any] = []
        if _MARK in before or (name == "POP" and stack[-1] is _MARK):
            while (top := stack.pop()) is not _MARK:
                items.append(top)
            before = before[: before.index(_MARK)] if _MARK in before else []
        elif name == "SETITEM":
            items = [stack[-1], stack[-2]]
        keys = items[1::2] if name in ("SETITEM", "SETITEMS", "DICT") else items
        if name in _KEYED and (odd := {key.name for key in keys} - _PLAIN):
            raise RefusedPickleError(f"it uses a {min(odd)} as a key")
        del stack[len(stack) - len(before) :]
        stack += after


def _opcodes(file: io.BytesIO, max_opcodes: int) -> Iterator[tuple[pickletools.OpcodeInfo, Any]]:
    """Opcodes with their arguments; unlike `pickletools.genops` takes Python 2's text as it is."""
    for _ in range(max_opcodes):
        opcode = _OPCODES[file.read(1)]
        argument = None
        if opcode.name == "STRING":
            argument = file.readline()
        elif opcode.arg is not None:
            argument = opcode.arg.reader(file)
        yield opcode, argument
        if opcode.name == "STOP":
            return
    raise RefusedPickleError(f"it has more than {max_opcodes} steps")


class Resolver:
    """Replaces a file's stand-ins by their values, each once.

    What the arrays take together, and what the value takes where everything shared counts as often
    as it is reached, is some times the length of `content` and `max_bytes` at most.
    """

    def __init__(self, content: bytes, max_bytes: int) -> None:
        self._most = self._left = min(max_bytes, _SMALL_BYTES + _UNFOLDED_TIMES * len(content))
        self._depth = 0
        self._done: dict[int, tuple[Any, Any]] = {}
        self._unfolded: dict[int, int] = {}

    def spend(self, count: int) -> None:
        """Raises RefusedPickleError once more bytes than allowed are asked for."""
        self._left -= count
        if self._left < 0:
            raise RefusedPickleError("its arrays claim more memory than a model file may hold")

    def __call__(self, value: Any) -> Any:
        """The value with all stand-ins within replaced."""
        if isinstance(value, type):
            raise RefusedPickleError(f"it holds {value.name} itself, not a value")
        if not isinstance(value, StandIn | list | tuple | dict):
            return value
        if id(value) in self._done:
            return self._done[id(value)][1]
        if self._depth > _MAX_DEPTH:
            raise RefusedPickleError("it is nested too deeply")
        self._depth += 1
        if isinstance(value, StandIn):
            result = value.convert(self)
        elif isinstance(value, dict):
            result = {key: self(item) for key, item in value.items()}
            self._unfold(result, [*result, *result.values()])
        else:
            result = type(value)(map(self, value))
            self._unfold(result, result)
        self._done[id(value)] = value, result
        self._depth -= 1
        return result

    def _unfold(self, result: Any, items: Iterable[Any]) -> None:
        """Count a container as a tree: whoever copies or walks it meets shared parts each time."""
        whole = _NODE_BYTES + sum(self._unfolded.get(id(i)) or _bytes_of(i) for i in items)
        if whole > self._most:
            raise RefusedPickleError("it repeats its parts without end")
        self._unfolded[id(result)] = whole


def _bytes_of(value: Any) -> int:
    """What a value other than a list, tuple or dict takes."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, set | frozenset):
        return _NODE_BYTES * (1 + len(value))
    return _NODE_BYTES + (len(value) if isinstance(value, str | bytes | bytearray) else 0)


def whole_numbers(shape: Any) -> tuple[int, ...]:
    """A shape as a tuple; raises RefusedPickleError for what is none."""
    if isinstance(shape, int) and not isinstance(shape, bool):
        shape = (shape,)
    if not isinstance(shape, tuple | list) or len(shape) > _MAX_DIMENSIONS:
        raise RefusedPickleError("it holds an array without a shape")
    sizes = [int(size) for size in shape if isinstance(size, int | np.integer)]
    if len(sizes) != len(shape) or any(not 0 <= size < 2**40 for size in sizes):
        raise RefusedPickleError("it claims an array of an impossible shape")
    return tuple(sizes)


def _data_type(made: StandIn, resolve: Resolver) -> np.dtype:
    """numpy.dtype of plain numbers or short texts; never of Python objects or records."""
    name, state = resolve(made.arguments[0]), resolve(made.state)
    if isinstance(name, bytes):
        name = name[:40].decode("latin-1")
    if not isinstance(name, str) or not _DTYPE.fullmatch(name):
        told = repr(name[:40]) if isinstance(name, str) else f"a {type(name).__name__}"
        raise RefusedPickleError(f"it holds an array of {told}, which are no numbers")
    if state is None:
        return np.dtype(name)
    if len(state) < 5 or state[1] not in ("<", ">", "|", "="):
        raise RefusedPickleError("it holds a broken number type")
    if any(part is not None for part in state[2:5]):
        raise RefusedPickleError("it holds an array of records")
    return np.dtype(name).newbyteorder(state[1])


def _array(made: StandIn, resolve: Resolver) -> Shaped[np.ndarray, "..."]:
    """numpy.ndarray from its state ([version,] shape, dtype, is_fortran, bytes)."""
    shape, dtype, fortran, raw = made.state[-4:]
    return _filled(resolve, shape, dtype, raw, bool(fortran))


def _filled(
    resolve: Resolver, shape: Any, dtype: Any, raw: Any, fortran: bool = False
) -> Shaped[np.ndarray, "..."]:
    """A writable array of its own; the claimed size is checked before anything is made."""
    dtype, raw, shape = resolve(dtype), resolve(raw), whole_numbers(resolve(shape))
    if not isinstance(dtype, np.dtype) or not isinstance(raw, bytes | bytearray | str):
        raise RefusedPickleError("it holds an array of objects, not of numbers")
    claimed = prod(shape) * dtype.itemsize
    if claimed != len(raw):
        raise RefusedPickleError(
            f"it claims an array of {claimed} bytes where there are {len(raw)}"
        )
    resolve.spend(max(claimed, *shape, 0))  # one without numbers may have rows without end
    raw = raw.encode("latin-1") if isinstance(raw, str) else raw
    flat = np.frombuffer(raw, dtype) if claimed else np.zeros(0, dtype)
    return flat.reshape(shape, order="F" if fortran else "C").copy(order="K")


def _scalar(made: StandIn, resolve: Resolver) -> Any:
    return _filled(resolve, (), *made.arguments)[()]


def _from_buffer(made: StandIn, resolve: Resolver) -> Shaped[np.ndarray, "..."]:
    raw, dtype, shape, order = made.arguments
    return _filled(resolve, shape, dtype, raw, order == "F")


def _parts(made: StandIn, resolve: Resolver) -> dict[str, Any]:
    state = made.state
    if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
        raise RefusedPickleError("it holds an object without named parts")
    return {key: resolve(value) for key, value in state.items()}


def _sparse(made: StandIn, resolve: Resolver) -> Any:
    """A compressed scipy.sparse matrix, its indices checked."""
    parts = _parts(made, resolve)
    shape = whole_numbers(parts.get("_shape", parts.get("shape")))
    arrays = tuple(parts[name] for name in ("data", "indices", "indptr"))
    if not all(isinstance(array, np.ndarray) and array.dtype.kind in "biuf" for array in arrays):
        raise RefusedPickleError("it holds a sparse matrix that is not of numbers")
    # Who uses it makes it dense.
    resolve.spend(prod(shape) * 8 + sum(array.nbytes for array in arrays))
    by_columns = made.name.rpartition(".")[2].startswith("csc")
    if len(arrays[2]) != shape[by_columns] + 1:
        raise RefusedPickleError("it holds a sparse matrix of the wrong size")
    kind = scipy.sparse.csc_matrix if by_columns else scipy.sparse.csr_matrix
    matrix = kind(arrays, shape=shape)
    matrix.check_format(full_check=True)
    return matrix


def _chumpy(made: StandIn, resolve: Resolver) -> Shaped[np.ndarray, "..."]:
    """A chumpy array's numbers: `x`, or for a selection those entries of another array."""
    parts = _parts(made, resolve)
    value = parts.get("x", parts.get("a"))
    if "x" not in parts and not {"a", "idxs"} <= parts.keys():
        raise RefusedPickleError(f"its {made.name} is computed from others by chumpy's code")
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        raise RefusedPickleError(f"its {made.name} does not hold numbers")
    if "x" in parts:
        return value
    chosen = parts["idxs"]
    if not isinstance(chosen, np.ndarray) or chosen.dtype.kind not in "iu":
        raise RefusedPickleError(f"its {made.name} chooses by something other than numbers")
    resolve.spend(value.nbytes + chosen.size * (8 + value.itemsize))
    shape = whole_numbers(parts.get("preferred_shape", chosen.shape))
    return value.reshape(-1)[chosen].reshape(shape)


def _encoded(made: StandIn, resolve: Resolver) -> bytes:
    """Bytes that protocol 2 stores as text of one character a byte."""
    text, *encoding = made.arguments or (b"",)
    if not isinstance(text, str | bytes) or encoding not in ([], ["latin1"], ["latin-1"]):
        raise RefusedPickleError("it makes bytes from something other than text")
    resolve.spend(len(text))
    return text.encode("latin-1") if isinstance(text, str) else text


def _reconstructed(made: StandIn, resolve: Resolver) -> Any:
    """copy_reg._reconstructor(class, object, None): an object of an allowed class."""
    kind, base, _ = made.arguments
    if not all(isinstance(part, type) for part in (kind, base)) or "object" not in base.name:
        raise RefusedPickleError("it makes an object of something that is no class")
    real = kind()
    real.__setstate__(made.state)
    return real.convert(resolve)


def _refused(made: StandIn, resolve: Resolver) -> Any:
    raise RefusedPickleError(f"it makes a bare {made.name}")


def _array_names() -> dict[str, type[StandIn]]:
    known: dict[str, Convert] = {
        "numpy.dtype": _data_type,
        "numpy.ndarray": _refused,
        "_codecs.encode": _encoded,
        "copy_reg._reconstructor": _reconstructed,
        "copyreg._reconstructor": _reconstructed,
    }
    for module in ("numpy.core", "numpy._core"):
        known[f"{module}.multiarray._reconstruct"] = _array
        known[f"{module}.multiarray.scalar"] = _scalar
        known[f"{module}.numeric._frombuffer"] = _from_buffer
    for module in ("builtins", "__builtin__"):
        known[f"{module}.object"] = _refused
        known[f"{module}.bytes"] = _encoded
    for form in ("csc", "csr"):
        for module in (f"scipy.sparse.{form}", f"scipy.sparse._{form}"):
            known |= {f"{module}.{form}_{kind}": _sparse for kind in ("matrix", "array")}
    for name in ("chumpy.ch.Ch", "chumpy.reordering.Select", "chumpy.Ch"):
        known[name] = _chumpy
    return {name: stand_in(name, convert) for name, convert in known.items()}


ARRAY_NAMES = _array_names()
"""numpy arrays, scipy.sparse matrices, chumpy arrays and plain containers, by full name."""
