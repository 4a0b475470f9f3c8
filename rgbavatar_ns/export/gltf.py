"""Gaussians as binary glTF with the ratified extension KHR_gaussian_splatting."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from rgbavatar_ns.avatar.model.blendshapes import feature_from_color
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.kernels import GaussianSet

EXTENSION = "KHR_gaussian_splatting"
_POINTS, _FLOAT, _ARRAY_BUFFER = 0, 5126, 34962
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAGIC, _VERSION = b"glTF", 2
_JSON_CHUNK, _BINARY_CHUNK = b"JSON", b"BIN\0"
_ALIGNMENT = 4
"""Bytes; of chunks, and of what a float begins at."""


def write_gltf(path: Path, gaussians: GaussianSet) -> int:
    """Write one set of Gaussians (B = 1) as a .glb and return how many it has.

    A primitive of points: position, rotation (unit quaternion, real part last), scale in metres
    and opacity as drawn, not their logs and logits, colour as the zeroth spherical harmonic; all
    float32. glTF's axes are the head model's: metres, y up, the face looks along +z. Readers
    without the extension see a cloud of points. Raises ValueError for more than one set, UserError
    where it cannot be written. Source: KHR_gaussian_splatting, ratified 2026.
    """
    if len(gaussians.means) != 1:
        raise ValueError(f"A file holds one set of Gaussians, not {len(gaussians.means)}.")
    described, binary = _document(_attributes(gaussians))
    text = json.dumps(described, separators=(",", ":"), allow_nan=False).encode("ascii")
    # A chunk of text is filled up with spaces, one of bytes with zeros.
    chunks = _chunk(_JSON_CHUNK, text, b" ") + _chunk(_BINARY_CHUNK, binary, b"\0")
    header = _MAGIC + struct.pack("<II", _VERSION, 12 + len(chunks))
    with atomic_write(path) as partial:
        partial.write_bytes(header + chunks)
    return gaussians.means.shape[1]


@torch.no_grad()
def _attributes(gaussians: GaussianSet) -> dict[str, Float[np.ndarray, "N C"]]:
    """Each attribute's values by its semantic."""
    unit_wxyz = torch.nn.functional.normalize(gaussians.quats_wxyz[0], dim=-1)
    values = {
        "POSITION": gaussians.means[0],
        f"{EXTENSION}:ROTATION": unit_wxyz.roll(-1, -1),
        f"{EXTENSION}:SCALE": gaussians.scales[0],
        f"{EXTENSION}:OPACITY": gaussians.opacities[0][:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": feature_from_color(gaussians.colors[0]),
    }
    return {name: value.cpu().numpy().astype("<f4") for name, value in values.items()}


def _document(attributes: dict[str, Float[np.ndarray, "N C"]]) -> tuple[dict[str, Any], bytes]:
    """The JSON part, and the buffer that its views cut up; an attribute after the other."""
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []
    binary = b""
    for name, values in attributes.items():
        content = values.tobytes()
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(content)}
        accessor = {
            "bufferView": len(views),
            "componentType": _FLOAT,
            "count": len(values),
            "type": _TYPES[values.shape[1]],
        }
        if name == "POSITION":
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        views.append(view | {"target": _ARRAY_BUFFER})
        accessors.append(accessor)
        binary += content
    splatting = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "attributes": {name: place for place, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: splatting},
    }
    described = {
        "asset": {"version": "2.0", "generator": "rgbavatar_ns"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "avatar"}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return described, binary


def _chunk(kind: bytes, content: bytes, filling: bytes) -> bytes:
    content += filling * (-len(content) % _ALIGNMENT)
    return struct.pack("<I", len(content)) + kind + content
