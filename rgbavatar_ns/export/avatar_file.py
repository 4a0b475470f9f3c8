"""An avatar as one file that can be drawn before it is all there.

Little-endian: 8 bytes of name, version and length of the manifest (uint32 each), the manifest, the
parts. Manifest and parts are gzips, each by itself, so that damage is found by their checksums. The
manifest says how each array is to be unpacked and which items of which arrays each part brings.

The first part is a whole head at rest: the mesh and the first Gaussians without their bases. The
second one makes it move; each of the others brings about as many Gaussians as there are already.
"""

import gzip
import json
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import expressive_numbers
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.seen_order import SeenOrder, seen_order
from rgbavatar_ns.export.stored_array import STORED_TYPES, stepped, unpacked
from rgbavatar_ns.export.views import front_camera
from rgbavatar_ns.export.web_arrays import Arrays, gaussian_arrays, network_arrays
from rgbavatar_ns.export.web_head import head_arrays
from rgbavatar_ns.reading import DamagedFileError, damage_told, parse_json, read_file

MAGIC = b"rgbavatr"
VERSION = 2
"""The first one was a page's block of arrays, without parts."""
FIRST_BYTES = 123_000
"""Up to the end of the first part: as base64 behind the page's programs it ends before 300 kB."""
_LEAST_FIRST = 1024
_HEADER = struct.Struct("<8sII")
_COMPRESSION = 9
_MOVES = ("offset_", "joint_directions", "network_")
"""How names begin of what a head at rest does not need."""
_MOST_FRAMES = 8
"""Of the performance, to see which Gaussians are needed; beside the ends of the film's range."""
_SIDE_PX = 256
_FINEST = 1e-7
"""The step of theta's numbers where they hardly change; float32 has no finer one at 1."""
_MANIFEST_BYTES = 8_000
"""About."""
_MOST_BYTES, _MOST_MANIFEST_BYTES = 1 << 28, 1 << 24


@dataclass(frozen=True)
class _Slice:
    """Items first to last of an array."""

    name: str
    first: int
    last: int


def avatar_parts(
    avatar: Avatar, manifest: dict[str, Any], theta: Float[Tensor, "F H"], more: Arrays
) -> list[bytes]:
    """The file in pieces, the first of which is enough to draw.

    manifest: what else the page is to know. theta: the performance, which may have no frames.
    more: other arrays, for the first piece.
    """
    film = film_range_theta(avatar, theta)
    with torch.no_grad():
        psi = avatar.weights(torch.cat([film, theta.to(film)])).abs().amax(0).cpu().numpy()
    seen = seen_order(avatar, film, front_camera(avatar, _SIDE_PX, _SIDE_PX))
    avatar = avatar.with_gaussians(seen.order)
    seen = SeenOrder(seen.order, seen.weight[seen.order], seen.cell[seen.order])
    gaussians = gaussian_arrays(avatar, seen, psi)
    layers, network = network_arrays(avatar)
    others = head_arrays(avatar) | network | more
    frames = {"theta": stepped(theta.T.cpu().numpy().astype(np.float64), _FINEST)}
    arrays = gaussians | others | frames
    count = avatar.num_gaussians
    base = [name for name in gaussians if not name.startswith(("basis_", "cell_"))]
    bases = [name for name in gaussians if name.startswith("basis_")]
    still = [name for name in others if not name.startswith(_MOVES)] + ["cell_weight"]
    moves = [name for name in others if name.startswith(_MOVES)]

    def whole(names: list[str]) -> list[_Slice]:
        return [_Slice(name, 0, arrays[name].items) for name in names]

    def some(names: list[str], first: int, last: int) -> list[_Slice]:
        return [_Slice(name, first, last) for name in names]

    first = _first_count(arrays, whole(still), base, count)
    slices = [whole(still) + some(base, 0, first)]
    slices.append(whole(moves) + some(bases, 0, first) + whole(["theta"]))
    places = [first]
    while places[-1] < count:
        places.append(min(2 * places[-1], count))
        slices.append(some(base + bases, *places[-2:]))
    packed = [_packed(arrays, part) for part in slices]
    manifest = manifest | {
        "format": "rgbavatar",
        "num_gaussians": count,
        "network": layers,
        "arrays": {name: array.described() for name, array in arrays.items()},
        "parts": [
            {
                "bytes": len(block),
                "slices": [[s.name, s.first, s.last] for s in part],
                "available": there,
            }
            for block, part, there in zip(packed, slices, [first, *places])
        ],
    }
    text = json.dumps(manifest, allow_nan=False, separators=(",", ":")).encode()
    described = gzip.compress(text, _COMPRESSION, mtime=0)
    header = _HEADER.pack(MAGIC, VERSION, len(described))
    return [header + described + packed[0], *packed[1:]]


@torch.no_grad()
def film_range_theta(avatar: Avatar, theta: Float[Tensor, "F H"]) -> Float[Tensor, "R H"]:
    """Rest, the lowest, highest and middle theta of the avatar's film, some of these frames.

    With the head where it is at rest. Of an avatar that knows no film, rest and frames alone.
    """
    low, high = avatar.theta_low, avatar.theta_high
    rows = [torch.zeros_like(low)[None]]
    if bool((low <= high).all()):
        rows.append(torch.stack([low, high, (low + high) / 2]))
    if len(theta) > 0:
        chosen = np.linspace(0, len(theta) - 1, min(len(theta), _MOST_FRAMES)).round().astype(int)
        rows.append(theta[chosen.tolist()].to(low))
    return torch.cat(rows) * expressive_numbers(avatar.layout).to(low)


def _first_count(arrays: Arrays, still: list[_Slice], base: list[str], count: int) -> int:
    """How many Gaussians fit into the first part, supposing that all are about as long."""
    tried = min(count, 4 * _LEAST_FIRST)
    without = len(_packed(arrays, still))
    each = (len(_packed(arrays, [_Slice(name, 0, tried) for name in base])) + 1) / (tried + 1)
    fitting = int((FIRST_BYTES - _MANIFEST_BYTES - without) / each)
    return min(max(fitting, _LEAST_FIRST), count)


def _packed(arrays: Arrays, part: list[_Slice]) -> bytes:
    block = b"".join(arrays[piece.name].packed(piece.first, piece.last) for piece in part)
    return gzip.compress(block, _COMPRESSION, mtime=0)


def read_avatar_file(path: Path) -> tuple[dict[str, Any], dict[str, Shaped[np.ndarray, "N C"]]]:
    """The manifest and the unpacked arrays, items first.

    Raises UserError where the file is none, of another version, cut off or damaged.
    """
    try:
        return _read(read_file(path, _MOST_BYTES))
    except DamagedFileError as error:
        raise UserError(
            f"{path} cannot be used: {error}.", "Export the avatar again, or copy the whole file."
        ) from None


def _read(content: bytes) -> tuple[dict[str, Any], dict[str, Shaped[np.ndarray, "N C"]]]:
    if content[: len(MAGIC)] != MAGIC[: len(content)] or not content:
        raise DamagedFileError("it is no avatar")
    if len(content) < _HEADER.size:
        raise DamagedFileError("it is cut off")
    _, version, length = _HEADER.unpack_from(content)
    if version != VERSION:
        raise DamagedFileError(f"it is an avatar of version {version}, and {VERSION} is read here")
    place = _HEADER.size + length
    manifest = parse_json(_inflated(content[_HEADER.size : place], length, _MOST_MANIFEST_BYTES))
    with damage_told():
        described = manifest["arrays"]
        pieces: dict[str, list[np.ndarray]] = {name: [] for name in described}
        for part in manifest["parts"]:
            slices = part["slices"]
            sizes = [_bytes(described[name]) * (last - first) for name, first, last in slices]
            if not 0 <= min(sizes, default=0) <= sum(sizes) <= _MOST_BYTES:
                raise DamagedFileError("it has parts of impossible sizes")
            block = _inflated(content[place : place + part["bytes"]], part["bytes"], sum(sizes))
            place += part["bytes"]
            starts = np.cumsum([0, *sizes])
            for (name, _, _), start, size in zip(slices, starts, sizes):
                pieces[name].append(unpacked(described[name], block[start : start + size]))
        return manifest, {name: np.concatenate(found, 1).T for name, found in pieces.items()}


def _bytes(described: dict[str, Any]) -> int:
    """Of one item in the file."""
    if described["stored"] not in STORED_TYPES:
        raise DamagedFileError(f"it has arrays of the type {described['stored']}")
    return described["columns"] * np.dtype(described["stored"]).itemsize


def _inflated(packed: bytes, length: int, most: int) -> bytes:
    """What a gzip of this length holds, at most so many bytes."""
    if len(packed) < length:
        raise DamagedFileError("it is cut off")
    reader = zlib.decompressobj(wbits=31)
    try:
        block = reader.decompress(packed, most + 1)
    except zlib.error:
        raise DamagedFileError("it is damaged") from None
    if not reader.eof or len(block) > most:
        raise DamagedFileError("it is damaged")
    return block
