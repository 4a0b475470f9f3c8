"""FLAME's UV map, which its pickle lacks: read from the files that carry it, or made anew."""

import io
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.reading import DamagedFileError, damage_told, load_arrays, read_file

UVMap = tuple[Float[np.ndarray, "VT 2"], Int[np.ndarray, "F 3"]]
"""UV coordinates, and which of them belong to the corners of each triangle."""

FILE_NAMES = (
    "flame_uv.npz",
    "FLAME_texture.npz",
    "head_template.obj",
    "head_template_mesh.obj",
    "head_template_color.obj",
)
"""Files that carry FLAME's UV map, in the order in which they are looked for."""
_COORDINATE_KEYS = ("vt", "verts_uvs", "uv", "uvs", "uv_coords")
_TRIANGLE_KEYS = ("ft", "textures_idx", "uv_faces", "faces_uvs")
_FROM_FLAME = (
    "Take head_template.obj or FLAME_texture.npz from FLAME's site (https://flame.is.tue.mpg.de), "
    "and put it beside the model."
)
_MOST_BYTES, _MOST_ROWS = 1 << 26, 200_000
"""FLAME's template has 1 MB and 10,000 triangles."""
_ROOM_FOR_TEETH = 0.95
"""The upper rest of the map stays free, as in FLAME's own."""


def find_uv_file(folders: Iterable[Path]) -> Path | None:
    """The first file in these folders that usually carries FLAME's UV map."""
    files = (folder / name for folder in folders for name in FILE_NAMES)
    return next(filter(os.path.isfile, files), None)


def read_uv_map(path: Path, faces: Int[np.ndarray, "F 3"]) -> UVMap:
    """The UV map of an npz (vt and ft) or an OBJ, for a mesh with these triangles.

    Raises UserError where the file is damaged, has no UV map, or belongs to another mesh.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise UserError(f"There is no UV map {path}.", _FROM_FLAME)
    try:
        is_npz = path.suffix.lower() == ".npz"
        uv, uv_faces, order = (*_read_npz(path), None) if is_npz else _read_obj(path)
    except DamagedFileError as error:
        raise UserError(f"{path} cannot be read: {error}.", _FROM_FLAME) from None
    if len(uv_faces) != len(faces):
        raise UserError(
            f"{path} maps {len(uv_faces)} triangles, but the model has {len(faces)}.", _FROM_FLAME
        )
    if order is not None:
        uv_faces = _in_order_of(path, faces, order, uv_faces)
    if not uv_faces.size or not np.isfinite(uv).all():
        raise UserError(f"The UV map in {path} is damaged.", _FROM_FLAME)
    if uv_faces.min() < 0 or uv_faces.max() >= len(uv):
        raise UserError(f"The UV map in {path} is damaged.", _FROM_FLAME)
    if uv.min() < -1e-3 or uv.max() > 1 + 1e-3:
        raise UserError(f"The UV map in {path} leaves the unit square.", _FROM_FLAME)
    return np.clip(uv, 0, 1), uv_faces


def make_uv_map(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> UVMap:
    """Charts of the mesh packed into the square without overlap, below the teeth's strip.

    Serves where FLAME's own map is not at hand: any map without overlap gives every part of the
    surface its Gaussians. Raises UserError where xatlas, which nerfstudio brings, is missing.
    """
    try:
        import xatlas
    except ImportError:
        raise UserError("The model has no UV map, and xatlas is missing.", _FROM_FLAME) from None
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding = 1024, 4
    atlas.generate(pack_options=options)
    _, uv_faces, uv = atlas[0]
    return uv * np.array([1, _ROOM_FOR_TEETH]), uv_faces.astype(np.int64)


def _read_npz(path: Path) -> UVMap:
    # FLAME_texture.npz holds a gigabyte of textures too.
    arrays = load_arrays(path, _MOST_BYTES, {*_COORDINATE_KEYS, *_TRIANGLE_KEYS})
    uv = next((arrays[key] for key in _COORDINATE_KEYS if key in arrays), None)
    uv_faces = next((arrays[key] for key in _TRIANGLE_KEYS if key in arrays), None)
    if uv is None or uv_faces is None:
        raise DamagedFileError("it holds no UV map (vt and ft)")
    if uv.ndim != 2 or uv.shape[1] < 2 or uv_faces.ndim != 2 or uv_faces.shape[1] != 3:
        raise DamagedFileError(f"it holds UV arrays of the shapes {uv.shape}, {uv_faces.shape}")
    if uv.dtype.kind != "f" or uv_faces.dtype.kind not in "iu":
        raise DamagedFileError(f"it holds UV arrays of {uv.dtype} and {uv_faces.dtype}")
    return uv[:, :2].astype(np.float64), uv_faces.astype(np.int64)


def _read_obj(
    path: Path,
) -> tuple[Float[np.ndarray, "VT 2"], Int[np.ndarray, "F 3"], Int[np.ndarray, "F 3"]]:
    """UV coordinates, their triangles, and the triangles of vertices, all counted from 0."""
    coordinates, corners = [], []
    content = read_file(path, _MOST_BYTES)
    with damage_told():
        for line in io.BytesIO(content):
            if line.startswith(b"vt "):
                coordinates.append([float(part) for part in line.split(None, 3)[1:3]])
            elif line.startswith(b"f "):
                # One more than are wanted, so that a larger face is none.
                parts = line.split(None, 4)[1:]
                corners.append([[int(n) for n in part.split(b"/", 2)[:2]] for part in parts[:4]])
            if max(len(coordinates), len(corners)) > _MOST_ROWS:
                raise DamagedFileError(f"it has more than {_MOST_ROWS} rows")
        triangles, uv = np.array(corners, dtype=np.int64), np.array(coordinates, np.float64)
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 2) or uv.ndim != 2 or uv.shape[1] != 2:
        raise DamagedFileError("it has no triangles with UV coordinates")
    return uv, triangles[..., 1] - 1, triangles[..., 0] - 1


def _in_order_of(
    path: Path,
    faces: Int[np.ndarray, "F 3"],
    order: Int[np.ndarray, "F 3"],
    uv_faces: Int[np.ndarray, "F 3"],
) -> Int[np.ndarray, "F 3"]:
    """The UV triangles in the model's order of triangles and corners."""
    if np.array_equal(faces, order):
        return uv_faces
    # Each triangle starts at its smallest vertex, then all are sorted.
    ours, theirs = (
        np.lexsort(np.take_along_axis(mesh, _from_smallest(mesh), 1).T[::-1])
        for mesh in (faces, order)
    )
    same = np.array_equal(
        np.take_along_axis(faces, _from_smallest(faces), 1)[ours],
        np.take_along_axis(order, _from_smallest(order), 1)[theirs],
    )
    if not same:
        raise UserError(f"{path} is the UV map of another mesh.", _FROM_FLAME)
    arranged = np.empty_like(uv_faces)
    turned = np.take_along_axis(uv_faces, _from_smallest(order), 1)[theirs]
    rows = np.empty_like(turned)
    rows[ours] = turned
    np.put_along_axis(arranged, _from_smallest(faces), rows, 1)
    return arranged


def _from_smallest(mesh: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "F 3"]:
    """Corner numbers that turn each triangle so that its smallest vertex comes first."""
    return (mesh.argmin(1)[:, None] + np.arange(3)) % 3
