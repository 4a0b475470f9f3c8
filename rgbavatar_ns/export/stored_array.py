"""Arrays as a page's file keeps them: whole numbers in columns, each column with its unit."""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Shaped

Whole = Literal["int8", "uint8", "int16", "uint16", "uint32"]
STORED_TYPES = ("int8", "uint8", "int16", "uint16", "uint32", "float32")


@dataclass(frozen=True)
class StoredArray:
    """C columns of N items, as they are in the file and as the page unpacks them.

    An unpacked float32 is low + unit * stored, of its column, or the exponential of that where
    `logarithmic`; other types are unpacked as they are stored, and their unit is for who uses them.
    """

    stored: Shaped[np.ndarray, "C N"]
    dtype: str
    """Of the unpacked numbers."""
    by_item: bool = True
    """Whether an item's columns lie side by side when unpacked; else a column's items do."""
    unit: Float[np.ndarray, "C"] | None = None
    low: Float[np.ndarray, "C"] | None = None
    logarithmic: bool = False
    differences: bool = False
    """Whether items are stored as differences from the one before, modulo the type's size."""

    @property
    def items(self) -> int:
        """The number N of items."""
        return self.stored.shape[1]

    def described(self) -> dict[str, Any]:
        """What is needed to unpack it, for JSON."""
        return {
            "stored": self.stored.dtype.name,
            "dtype": self.dtype,
            "columns": self.stored.shape[0],
            "items": self.items,
            "by_item": self.by_item,
            "unit": None if self.unit is None else self.unit.tolist(),
            "low": None if self.low is None else self.low.tolist(),
            "logarithmic": self.logarithmic,
            "differences": self.differences,
        }

    def packed(self, first: int, last: int) -> bytes:
        """Items first to last: column after column, of each all first bytes, then all second ...

        So that a compressor finds the high bytes, which hardly differ, side by side; and of signed
        16 bits they are mostly zero, since 0, -1, 1, -2 ... are stored as 0, 1, 2, 3 ...
        """
        values = self.stored[:, first:last]
        if self.differences:
            values = np.diff(values, axis=1, prepend=values.dtype.type(0))
        if values.dtype == np.int16:
            values = ((values << 1) ^ (values >> 15)).view(np.uint16)
        little = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"))
        planes = little.view(np.uint8).reshape(*values.shape, values.itemsize)
        return np.moveaxis(planes, 2, 1).tobytes()


def unpacked(described: dict[str, Any], block: bytes) -> Shaped[np.ndarray, "C n"]:
    """The columns of as many items as a block from `StoredArray.packed` has bytes for.

    What the page's `unpackInto` does (data.js), in Python.
    """
    dtype, columns = np.dtype(described["stored"]), described["columns"]
    planes = np.frombuffer(block, np.uint8).reshape(columns, dtype.itemsize, -1)
    little = np.ascontiguousarray(np.moveaxis(planes, 1, 2)).view(dtype.newbyteorder("<"))
    values = little[..., 0].astype(dtype)
    if dtype == np.int16:
        folded = values.view(np.uint16)
        values = (folded >> 1).view(np.int16) ^ -(folded & 1).view(np.int16)
    if described["differences"]:
        values = np.cumsum(values, 1, dtype=dtype)
    if described["dtype"] == "float32" and described["unit"] is not None:
        low, unit = (np.array(described[name], np.float64)[:, None] for name in ("low", "unit"))
        values = low + unit * values
        values = np.exp(values) if described["logarithmic"] else values
    return values.astype(described["dtype"])


def stepped(
    values: Float[np.ndarray, "C N"],
    step: float | Float[np.ndarray, "C"],
    stored: Literal["int8", "int16"] = "int16",
    dtype: Literal["int8", "int16", "float32"] = "float32",
    *,
    by_item: bool = True,
) -> StoredArray:
    """Round to multiples of a step, or of a coarser one where the type would not reach.

    The error of a number is at most half of its column's unit.
    """
    reach = np.abs(values).max(1, initial=0).astype(np.float64)
    unit = np.maximum(reach / np.iinfo(stored).max, step)
    rounded = np.rint(values / unit[:, None]).astype(stored)
    return StoredArray(rounded, dtype, by_item, unit, np.zeros_like(unit))


def ranged(
    values: Float[np.ndarray, "C N"],
    stored: Literal["uint8", "uint16"] = "uint8",
    *,
    logarithmic: bool = False,
) -> StoredArray:
    """Round to as many steps between each column's lowest and highest number as the type has."""
    values = (np.log(values) if logarithmic else values).astype(np.float64)
    empty = values.shape[1] == 0
    low = np.zeros(len(values)) if empty else values.min(1)
    unit = np.zeros(len(values)) if empty else (values.max(1) - low) / np.iinfo(stored).max
    safe = np.where(unit > 0, unit, 1.0)[:, None]
    rounded = np.rint((values - low[:, None]) / safe).astype(stored)
    return StoredArray(rounded, "float32", True, unit, low, logarithmic)


def exact(
    values: Shaped[np.ndarray, "..."],
    stored: Whole | Literal["float32"],
    dtype: str | None = None,
    *,
    differences: bool = False,
) -> StoredArray:
    """Numbers that the type holds as they are; the rows of the first axis are items."""
    columns = values.astype(stored).reshape(len(values), math.prod(values.shape[1:])).T
    return StoredArray(columns, dtype or stored, differences=differences)
