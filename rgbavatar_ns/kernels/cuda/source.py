"""The kernels' sources, and what Python has to know of them, read from the sources themselves."""

import ctypes
import functools
import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_HERE = Path(__file__).parent
FOLDERS = (_HERE / "src", _HERE.parent / "shared")
"""Where the sources lie."""
MAIN = "kernels.cu"
"""The translation unit; the other sources are included by it."""

_SCALARS = {"int": ctypes.c_int32, "float": ctypes.c_float}
_STRUCT = re.compile(r"^struct (\w+) \{\n(.*?)^\};", re.MULTILINE | re.DOTALL)
_FIELD = re.compile(r"^  (?:const )?(\w+)(\*?) (\w+);")
_KERNEL = re.compile(r"^RGBAVATAR_KERNEL\((\w+), (\w+), (\w+)(?:, \w+)?\)", re.MULTILINE)
_CONSTANT = re.compile(r"\b(k[A-Z]\w*) = (\d+)[,; ]")


@dataclass(frozen=True)
class Field:
    """One argument: of a plain type, or a pointer to one, or a structure."""

    name: str
    kind: str
    is_pointer: bool

    @property
    def pointed(self) -> str | None:
        """The type behind a pointer."""
        return self.kind if self.is_pointer else None


@dataclass(frozen=True)
class Kernel:
    """A kernel's one argument, a structure, and the threads of its blocks."""

    name: str
    arguments: type[ctypes.Structure]
    threads: int


@functools.cache
def sources() -> dict[str, str]:
    """Every source by the name that it is included by."""
    files = sorted(p for folder in FOLDERS for p in folder.iterdir() if p.suffix != ".pyc")
    return {path.name: path.read_text() for path in files}


@functools.cache
def source_hash() -> str:
    """A name for what would be compiled."""
    digest = hashlib.sha256()
    for name, text in sources().items():
        digest.update(f"{name}\0{text}\0".encode())
    return digest.hexdigest()[:16]


@functools.cache
def constants() -> dict[str, int]:
    """The sizes that host and device share, by their names in the sources."""
    return {n: int(v) for text in sources().values() for n, v in _CONSTANT.findall(text)}


@functools.cache
def structures() -> dict[str, type[ctypes.Structure]]:
    """The structures of `arguments.h`, laid out as a C compiler does."""
    found: dict[str, type[ctypes.Structure]] = {}
    for name, body in _STRUCT.findall(sources()["arguments.h"]):
        layout = [_ctype(line, found) for line in body.splitlines() if line.strip()]
        found[name] = type(name, (ctypes.Structure,), {"_fields_": layout})
    return found


def _ctype(line: str, known: dict[str, type[ctypes.Structure]]) -> tuple[str, type]:
    match = _FIELD.match(line)
    if match is None:
        raise ValueError(f"arguments.h: {line!r} is no field. Write one plain field a line.")
    kind, pointer, name = match.groups()
    if pointer:
        return name, ctypes.c_void_p
    return name, _SCALARS[kind] if kind in _SCALARS else known[kind]


@functools.cache
def fields(structure: str) -> tuple[Field, ...]:
    """The fields of a structure of `arguments.h`, in order."""
    bodies = dict(_STRUCT.findall(sources()["arguments.h"]))
    return tuple(_fields(bodies[structure]))


def _fields(body: str) -> Iterator[Field]:
    for match in filter(None, map(_FIELD.match, body.splitlines())):
        yield Field(match[3], match[1], bool(match[2]))


@functools.cache
def kernels() -> dict[str, Kernel]:
    """Every kernel by its name."""
    return {
        name: Kernel(name, structures()[arguments], constants()[threads])
        for text in sources().values()
        for name, arguments, threads in _KERNEL.findall(text)
    }
