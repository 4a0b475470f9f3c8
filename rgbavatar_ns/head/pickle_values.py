"""The names that a model file's pickle may ask for, and the arrays that they become."""

import re
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Shaped

from rgbavatar_ns.head.pickle_machine import (
    Budget,
    PickleGlobal,
    RefusedPickleError,
    StandIn,
    checked_keys,
    pairs,
)

_DTYPE = re.compile(r"[<>=|]?(\?|[bBhHiIlLqQefdFD]|b1|[iu][1248]|f[248]|c8|c16|[SU]\d{1,4})")
_MAX_DIMENSIONS, _MAX_DEPTH = 32, 100


class DataType(StandIn):
    """numpy.dtype of plain numbers or short texts; never of Python objects or records."""

    def __init__(self, name: Any) -> None:
        if isinstance(name, bytes):
            name = name.decode("latin-1")
        if not isinstance(name, str) or not _DTYPE.fullmatch(name):
            raise RefusedPickleError(
                f"it holds an array of {str(name)[:40]!r}, which are no numbers"
            )
        self.value = np.dtype(name)

    def set_state(self, state: Any) -> None:
        """Take the byte order; records and nested types are refused."""
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", ">", "|", "="):
            raise RefusedPickleError("it holds a broken number type")
        if any(part is not None for part in state[2:5]):
            raise RefusedPickleError("it holds an array of records")
        self.value = self.value.newbyteorder(state[1])


class Array(StandIn):
    """numpy.ndarray: made from its state when all of the pickle is read."""

    def __init__(self) -> None:
        self.shape: tuple[int, ...] = (0,)
        self.dtype = np.dtype(np.int8)
        self.raw: bytes | str = b""
        self.fortran = False

    def set_state(self, state: Any) -> None:
        """Take ([version,] shape, dtype, is_fortran, bytes), whose length has to agree."""
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise RefusedPickleError("it holds a broken array")
        shape, dtype, fortran, raw = state[-4:]
        self.fill(shape, dtype, bool(fortran), raw)

    def fill(self, shape: Any, dtype: Any, fortran: bool, raw: Any) -> None:
        """Check everything before anything of the claimed size is made."""
        if not isinstance(dtype, DataType) or not isinstance(raw, bytes | str):
            raise RefusedPickleError("it holds an array of objects, not of numbers")
        self.shape = whole_numbers(shape)
        self.dtype, self.fortran, self.raw = dtype.value, fortran, raw
        claimed = _count(self.shape) * self.dtype.itemsize
        if claimed != len(raw):
            raise RefusedPickleError(
                f"it claims an array of {claimed} bytes where there are {len(raw)}"
            )

    def resolved(self, budget: Budget) -> Shaped[np.ndarray, "..."]:
        """A writable array of its own."""
        budget.spend(len(self.raw))
        raw = self.raw.encode("latin-1") if isinstance(self.raw, str) else self.raw
        flat = np.frombuffer(raw, self.dtype) if self.dtype.itemsize else np.zeros(0, self.dtype)
        return flat.reshape(self.shape, order="F" if self.fortran else "C").copy(order="K")


class Sparse(StandIn):
    """A scipy.sparse matrix in one of the three plain forms."""

    def __init__(self, form: str) -> None:
        self.form = form
        self.state: dict[str, Any] = {}

    def set_state(self, state: Any) -> None:
        """Take the dictionary of its arrays."""
        self.state = _text_keys(state)

    def resolved(self, resolve: Callable[[Any], Any]) -> Any:
        """The scipy matrix, its indices checked."""
        shape = whole_numbers(self.state.get("_shape", self.state.get("shape")))
        names = ("data", "row", "col") if self.form == "coo" else ("data", "indices", "indptr")
        arrays = {name: resolve(self.state.get(name)) for name in names if name in self.state}
        if self.form == "coo" and "coords" in self.state:
            arrays |= zip(("row", "col"), resolve(self.state["coords"]))
        numbers = [arrays.get(name) for name in names]
        if len(shape) != 2 or not all(isinstance(a, np.ndarray) and a.ndim == 1 for a in numbers):
            raise RefusedPickleError("it holds a broken sparse matrix")
        data, first, second = (np.asarray(array) for array in numbers)
        if data.dtype.kind not in "biuf" or first.dtype.kind not in "iu":
            raise RefusedPickleError("it holds a sparse matrix that is not of numbers")
        if self.form == "coo":
            return scipy.sparse.coo_matrix((data, (first, second)), shape=shape)
        if len(second) != shape[0 if self.form == "csr" else 1] + 1:
            raise RefusedPickleError("it holds a sparse matrix of the wrong size")
        kind = {"csc": scipy.sparse.csc_matrix, "csr": scipy.sparse.csr_matrix}[self.form]
        matrix = kind((data, first, second), shape=shape)
        matrix.check_format(full_check=True)
        return matrix


class Chumpy(StandIn):
    """A chumpy array, of which only the numbers are wanted."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.state: dict[str, Any] = {}

    def set_state(self, state: Any) -> None:
        """Take the dictionary of its attributes."""
        self.state = _text_keys(state)

    def resolved(self, resolve: Callable[[Any], Any], budget: Budget) -> Shaped[np.ndarray, "..."]:
        """Its numbers: `x`, or for a selection those entries of another array."""
        if "x" in self.state:
            value = resolve(self.state["x"])
        elif {"a", "idxs"} <= set(self.state):
            whole, chosen = resolve(self.state["a"]), np.asarray(resolve(self.state["idxs"]))
            budget.spend(chosen.size * 8)
            shape = whole_numbers(self.state.get("preferred_shape", chosen.shape))
            value = np.asarray(whole).reshape(-1)[chosen].reshape(shape)
        else:
            raise RefusedPickleError(f"its {self.name} is computed from others by chumpy's code")
        value = np.asarray(value)
        if value.dtype.kind not in "biuf":
            raise RefusedPickleError(f"its {self.name} does not hold numbers")
        return value


def resolve(value: Any, budget: Budget, other: Callable[[Any], Any] | None = None) -> Any:
    """Replace all stand-ins by their arrays; `other` knows those that are not of this file."""
    done: dict[int, Any] = {}
    kept: list[Any] = []

    def visit(value: Any, depth: int) -> Any:
        if not isinstance(value, StandIn | list | tuple | dict | set | PickleGlobal):
            return value
        if id(value) in done:
            return done[id(value)]
        if depth > _MAX_DEPTH:
            raise RefusedPickleError("it is nested too deeply")
        kept.append(value)
        if isinstance(value, list | dict):
            # In place, and known before its items: it may contain itself.
            done[id(value)] = value
            for key, item in list(value.items() if isinstance(value, dict) else enumerate(value)):
                value[key] = visit(item, depth + 1)
            return value
        done[id(value)] = result = convert(value, depth + 1)
        return result

    def convert(value: Any, depth: int) -> Any:
        if isinstance(value, tuple):
            return tuple(visit(item, depth) for item in value)
        if isinstance(value, DataType):
            return value.value
        if isinstance(value, Array):
            return value.resolved(budget)
        if isinstance(value, Sparse):
            return value.resolved(lambda part: visit(part, depth))
        if isinstance(value, Chumpy):
            done[id(value)] = None
            return value.resolved(lambda part: visit(part, depth), budget)
        if isinstance(value, PickleGlobal):
            raise RefusedPickleError(f"it holds {value.name} itself, not a value")
        return other(value) if other is not None and isinstance(value, StandIn) else value

    return visit(value, 0)


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


def _count(shape: tuple[int, ...]) -> int:
    count = 1
    for size in shape:
        count *= size
    return count


def _text_keys(state: Any) -> dict[str, Any]:
    if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
        raise RefusedPickleError("it holds an object without named parts")
    return state


def _items(budget: Budget, arguments: tuple[Any, ...]) -> list[Any]:
    """The items of a container given to the constructor of another."""
    if not arguments:
        return []
    (items,) = arguments
    if not isinstance(items, list | tuple | set | frozenset):
        raise RefusedPickleError("it fills a container from something that is none")
    budget.spend(8 * len(items))
    return list(items)


def _pair_items(budget: Budget, arguments: tuple[Any, ...]) -> list[tuple[Any, Any]]:
    items = _items(budget, arguments)
    if not all(isinstance(item, list | tuple) and len(item) == 2 for item in items):
        raise RefusedPickleError("it fills a dictionary with something other than pairs")
    return pairs([part for item in items for part in item])


def _encoded(budget: Budget, arguments: tuple[Any, ...]) -> bytes:
    """Bytes that protocol 2 stores as text of one character a byte."""
    if not arguments:
        return b""
    text = arguments[0]
    if not isinstance(text, str | bytes) or list(arguments[1:]) not in (
        [],
        ["latin1"],
        ["latin-1"],
    ):
        raise RefusedPickleError("it makes bytes from something other than text")
    budget.spend(len(text))
    return text.encode("latin-1") if isinstance(text, str) else text


def _scalar(budget: Budget, arguments: tuple[Any, ...]) -> Any:
    dtype, raw = arguments
    array = Array()
    array.fill((), dtype, False, raw)
    return array.resolved(budget)[()]


def _from_buffer(budget: Budget, arguments: tuple[Any, ...]) -> Array:
    raw, dtype, shape, order = arguments
    array = Array()
    array.fill(shape, dtype, order == "F", raw)
    return array


def _reconstructed(budget: Budget, arguments: tuple[Any, ...]) -> Any:
    """copy_reg._reconstructor(class, object, None): an empty object of an allowed class."""
    made, base, state = arguments
    if not isinstance(made, PickleGlobal) or not isinstance(base, PickleGlobal):
        raise RefusedPickleError("it makes an object of something that is no class")
    if base.name not in ("builtins.object", "__builtin__.object") or state is not None:
        raise RefusedPickleError(f"it makes a {made.name} out of a {base.name}")
    return made.make(budget, ())


def _object(budget: Budget, arguments: tuple[Any, ...]) -> Any:
    raise RefusedPickleError("it makes a bare object")


def _makers() -> dict[str, Callable[[Budget, tuple[Any, ...]], Any]]:
    makers: dict[str, Callable[[Budget, tuple[Any, ...]], Any]] = {
        "numpy.dtype": lambda budget, arguments: DataType(arguments[0]),
        "numpy.ndarray": lambda budget, arguments: Array(),
        "_codecs.encode": _encoded,
        "copy_reg._reconstructor": _reconstructed,
        "copyreg._reconstructor": _reconstructed,
        "collections.OrderedDict": lambda budget, arguments: OrderedDict(
            _pair_items(budget, arguments)
        ),
    }
    for module in ("numpy.core", "numpy._core"):
        makers[f"{module}.multiarray._reconstruct"] = lambda budget, arguments: Array()
        makers[f"{module}.multiarray.scalar"] = _scalar
        makers[f"{module}.numeric._frombuffer"] = _from_buffer
    for module in ("builtins", "__builtin__"):
        makers |= {
            f"{module}.object": _object,
            f"{module}.bytes": _encoded,
            f"{module}.bytearray": _encoded,
            f"{module}.list": _items,
            f"{module}.tuple": lambda budget, arguments: tuple(_items(budget, arguments)),
            f"{module}.dict": lambda budget, arguments: dict(_pair_items(budget, arguments)),
            f"{module}.set": lambda budget, arguments: set(checked_keys(_items(budget, arguments))),
            f"{module}.frozenset": lambda budget, arguments: frozenset(
                checked_keys(_items(budget, arguments))
            ),
        }
    for form in ("csc", "csr", "coo"):
        for module in (f"scipy.sparse.{form}", f"scipy.sparse._{form}"):
            for kind in ("matrix", "array"):
                makers[f"{module}.{form}_{kind}"] = lambda budget, arguments, form=form: Sparse(
                    form
                )
    for name in ("chumpy.ch.Ch", "chumpy.reordering.Select", "chumpy.Ch"):
        makers[name] = lambda budget, arguments, name=name: Chumpy(name)
    return makers


ARRAY_GLOBALS = {name: PickleGlobal(name, make) for name, make in _makers().items()}
"""numpy arrays, scipy.sparse matrices, chumpy arrays and plain containers, by full name."""
