"""What all attacks on files share: bytes turned, cut, and replaced; JSON values made absurd."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

Case = tuple[str, Callable[[], object]]
"""What an attack is called, and the attack: UserError or nothing comes of it, else a fault."""

WRONG_VALUES: tuple[Any, ...] = (
    True, False, None, "text", "", "\0", "x" * 5000, "../" * 40 + "etc/passwd", [], {}, [[1.0]],
    [True] * 3, ["1"], 0, -1, 1.5, 10**18, -(10**18), 1e300, -1e300, 1e5, float("nan"),
    float("inf"), {"a": {"b": [1]}}, [0.0] * 1000,
)  # fmt: skip
WRONG_TEXTS = (
    b"9" * 5000,
    b"[" * 3000,
    b"[" * 3000 + b"]" * 3000,
    b'"\\ud800"',
    b"1e999",
    b"-",
    b"",
)
"""In the place of a JSON value."""


def turned(content: bytes, generator: np.random.Generator, bits: int = 3) -> bytes:
    """The bytes with a few bits turned over."""
    changed = bytearray(content)
    for _ in range(int(generator.integers(1, bits + 1))):
        changed[int(generator.integers(len(changed)))] ^= 1 << int(generator.integers(8))
    return bytes(changed)


def harm(path: Path, generator: np.random.Generator, is_checked: bool = False) -> str:
    """Do something to a file in its place; is_checked: its format has means to see turned bits."""
    content = path.read_bytes()
    kinds = ["cut", "empty", "garbage", "folder", "fifo", "missing", "zeros", "doubled"]
    kind = str(generator.choice(kinds + ["turned"] * 8 * is_checked))
    path.unlink()
    if kind == "turned":
        path.write_bytes(turned(content, generator))
    elif kind == "cut":
        path.write_bytes(content[: int(generator.integers(len(content) + 1))])
    elif kind in ("empty", "garbage", "zeros"):
        size = {"empty": 0}.get(kind, 1000)
        path.write_bytes(bytes(size) if kind == "zeros" else generator.bytes(size))
    elif kind == "folder":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "doubled":
        path.write_bytes(content + content)
    return kind


def harm_json(path: Path, generator: np.random.Generator) -> str:
    """Remove a value somewhere in a JSON file, or put an absurd one or an absurd text there."""
    content = json.loads(path.read_text())
    places = list(_places(content))
    holder, key = places[int(generator.integers(len(places)))]
    kind = int(generator.integers(5))
    if kind == 0 and isinstance(holder, dict):
        del holder[key]
        path.write_text(json.dumps(content))
        return f"without {key}"
    if kind == 1:
        holder[key] = "@@"
        text = WRONG_TEXTS[int(generator.integers(len(WRONG_TEXTS)))]
        path.write_bytes(json.dumps(content).encode().replace(b'"@@"', text))
        return f"{key}: {text[:8]!r}"
    value = WRONG_VALUES[int(generator.integers(len(WRONG_VALUES)))]
    holder[key] = value
    path.write_text(json.dumps(content))
    return f"{key}: {str(value)[:12]!r}"


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(min(len(value), 5)):
            yield value, key
            yield from _places(value[key])


@contextmanager
def copied(folder: Path) -> Iterator[Path]:
    """A copy of the folder beside it, removed afterwards."""
    copy = folder.with_name(f"{folder.name}.harmed")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    try:
        yield copy
    finally:
        shutil.rmtree(copy)
