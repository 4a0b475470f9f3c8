"""Tensors and numbers into the structure that a kernel takes, checked name by name."""

import ctypes
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rgbavatar_ns.kernels.cuda.source import fields, structures

_POINTED = {
    "float": torch.float32,
    "uint8_t": torch.uint8,
    "uint32_t": torch.int32,
    "int64_t": torch.int64,
    "uint64_t": torch.int64,
}


def fill(structure: str, values: Mapping[str, Any], device: torch.device) -> ctypes.Structure:
    """The structure of `arguments.h` with these values; tensors are taken by address.

    Raises:
        TypeError: a value is missing, unknown, of another type or on another device, or a tensor
            is not contiguous. Compiled code reads what it is promised.
    """
    wanted = fields(structure)
    names = {field.name for field in wanted}
    if names != set(values):
        raise TypeError(f"{structure}: missing or unknown {sorted(names ^ set(values))}.")
    out = structures()[structure]()
    for field in wanted:
        value = values[field.name]
        if field.pointed is not None:
            value = _address(structure, field.name, field.pointed, value, device)
        elif isinstance(value, Mapping):
            value = fill(field.kind, value, device)
        setattr(out, field.name, value)
    return out


def _address(
    structure: str, name: str, pointed: str, value: Tensor | None, device: torch.device
) -> int | None:
    if value is None:
        return None
    if value.dtype != _POINTED[pointed] or value.device != device or not value.is_contiguous():
        raise TypeError(
            f"{structure}.{name}: {value.dtype} on {value.device}, strides {value.stride()}, where "
            f"contiguous {_POINTED[pointed]} on {device} is read."
        )
    return value.data_ptr()
