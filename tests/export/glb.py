"""A reader of binary glTF by the specification's text, for the tests: header, chunks, accessors."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

_WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def read_glb(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The JSON part, and the first primitive's attributes by name [N, C]; asserts what is said."""
    content = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    chunks, place = [], 12
    while place < length:
        size, kind = struct.unpack("<I4s", content[place : place + 8])
        assert size % 4 == 0
        chunks.append((kind, content[place + 8 : place + 8 + size]))
        place += 8 + size
    assert [kind for kind, _ in chunks] == [b"JSON", b"BIN\0"]
    described, binary = json.loads(chunks[0][1]), chunks[1][1]
    assert described["buffers"] == [{"byteLength": len(binary)}]
    attributes = {}
    for name, number in described["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = described["accessors"][number]
        view = described["bufferViews"][accessor["bufferView"]]
        assert accessor["componentType"] == 5126
        assert view["byteOffset"] % 4 == 0
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        values = np.frombuffer(part, "<f4").reshape(accessor["count"], _WIDTH[accessor["type"]])
        attributes[name] = values
        for end, reduced in (("min", values.min(0)), ("max", values.max(0))):
            assert end not in accessor or accessor[end] == reduced.tolist()
    return described, attributes
