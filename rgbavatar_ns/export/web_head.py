"""A person's head as a page wants it: only what carries Gaussians, in whole numbers."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.export.stored_array import StoredArray, exact, ranged, stepped
from rgbavatar_ns.head.frames import edges_to_frame
from rgbavatar_ns.head.joints import ROOT

_OFFSET_STEP_M = 5e-5
"""Of an expression at strength 1; off by half of it, a twentieth of a pixel of most films."""
_WITHIN_RADIANS = 1e-2
"""How far a triangle's tangents may turn by the rounding of UV; others are kept in full."""
_OUTLINE_DIRECTIONS = 512
"""The head's box, whose middle cameras turn about, is right to a tenth of a millimetre."""


def head_arrays(avatar: Avatar) -> dict[str, StoredArray]:
    """The neutral head, its offsets as sparse columns, joints, skinning and the triangles' UV.

    Of the vertices only those of triangles that carry Gaussians, and those that the box of the
    turned head touches.
    """
    arrays = avatar.head.arrays
    mesh = avatar.anchors.triangles(with_rest_length=True)
    triangles = mesh["triangle_vertices"].cpu().numpy()
    identity = avatar.identity.cpu().numpy().astype(np.float64)
    shapes = arrays.shapedirs.astype(np.float64)
    neutral = arrays.v_template + shapes[..., : arrays.num_identity] @ identity
    kept = _outline(neutral, arrays.skinning_weights[:, ROOT] < 0.5)
    kept[triangles] = True
    number = np.cumsum(kept) - 1
    expressions = shapes[..., arrays.num_identity :]
    columns = [expressions]
    if arrays.eyelid_dirs is not None:
        columns.append(arrays.eyelid_dirs)
    if arrays.posedirs.any():
        columns.append(arrays.posedirs)
    with torch.no_grad():
        joints = avatar.head.joints(avatar.identity).cpu().numpy()
    moved = np.einsum("jv,vcx->xjc", arrays.joint_regressor.astype(np.float64), expressions)
    rested = len(triangles) if avatar.config.scale_with_triangle else 0
    return {
        "neutral_vertices": ranged(neutral[kept].T, "uint16"),
        "skinning_weights": ranged(arrays.skinning_weights[kept].T, "uint16"),
        "joints": exact(joints, "float32"),
        "joint_directions": exact(moved, "float32"),
        "rest_length": exact(mesh["rest_length"].cpu().numpy()[:rested], "float32"),
        **_sparse_columns(np.concatenate(columns, -1)[kept]),
        **_uv_arrays(avatar, number[triangles], mesh["edges_to_frame"].cpu().numpy()),
    }


def _outline(
    vertices: Float[np.ndarray, "V 3"], counted: Bool[np.ndarray, "V"]
) -> Bool[np.ndarray, "V"]:
    """The counted vertices that are farthest in some direction (a spiral over the sphere)."""
    place = (np.arange(_OUTLINE_DIRECTIONS) + 0.5) / _OUTLINE_DIRECTIONS
    height, angle = 1 - 2 * place, math.pi * (1 + math.sqrt(5)) * place * _OUTLINE_DIRECTIONS
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(angle), height, ring * np.sin(angle)])
    along = np.where(counted[:, None], vertices @ directions, -np.inf)
    touched = np.zeros(len(vertices), bool)
    touched[along.argmax(0)] = counted.any()
    return touched


def _sparse_columns(offsets: Float[np.ndarray, "V 3 C"]) -> dict[str, StoredArray]:
    """Only the vertices that each column moves by more than half a step."""
    dense = stepped(offsets.transpose(2, 1, 0).reshape(offsets.shape[2], -1), _OFFSET_STEP_M)
    assert dense.unit is not None
    by_column = dense.stored.reshape(-1, 3, len(offsets))
    column, vertex = np.nonzero(by_column.any(1))
    start = np.searchsorted(column, np.arange(len(by_column) + 1))
    few = len(offsets) <= np.iinfo(np.uint16).max
    return {
        "offset_start": exact(start, "uint32"),
        "offset_vertex": exact(vertex, "uint16" if few else "uint32", differences=True),
        "offset_value": exact(by_column[column, :, vertex], "int16"),
        "offset_unit": exact(dense.unit, "float32"),
    }


def _uv_arrays(
    avatar: Avatar,
    triangles: Int[np.ndarray, "U 3"],
    edges: Float[np.ndarray, "U 2 2"],
) -> dict[str, StoredArray]:
    """The triangles' corners and their UV, from which the page finds `edges_to_frame` again.

    A vertex's first UV has the vertex's number; seams have others. Triangles too thin for rounded
    UV are named with their matrix.
    """
    uv = avatar.head.uv.cpu().numpy().astype(np.float64)
    used = torch.unique(avatar.anchors.triangle_index).cpu()
    uv_faces = avatar.head.uv_faces.cpu().numpy()[used]
    vertices = int(triangles.max(initial=-1)) + 1
    first = np.full(vertices, -1)
    # From the last to the first, so that the first one stays.
    first[triangles.reshape(-1)[::-1]] = uv_faces.reshape(-1)[::-1]
    seams = np.setdiff1d(uv_faces, first)
    number = np.zeros(len(uv), int)
    number[seams] = vertices + np.arange(len(seams))
    corner = np.where(first[triangles] == uv_faces, triangles, number[uv_faces])
    table = ranged(uv[np.concatenate([np.maximum(first, 0), seams])].T, "uint16")
    assert table.unit is not None
    assert table.low is not None
    rounded = (table.low[:, None] + table.unit[:, None] * table.stored).T.astype(np.float32)
    again = edges_to_frame(torch.from_numpy(rounded), torch.from_numpy(corner)).numpy()
    off = np.flatnonzero(_turned_radians(edges, again).max(1) > _WITHIN_RADIANS)
    few = len(rounded) <= np.iinfo(np.uint16).max
    index = "uint16" if few else "uint32"
    return {
        "triangle_vertices": exact(triangles, index, "uint32", differences=True),
        "triangle_seams": exact(corner - triangles, index, "uint32"),
        "uv": table,
        "thin_triangle": exact(off, "uint32", differences=True),
        "thin_edges_to_frame": exact(edges[off].astype(np.float32), "float32"),
    }


def _turned_radians(
    ours: Float[np.ndarray, "U 2 2"], others: Float[np.ndarray, "U 2 2"]
) -> Float[np.ndarray, "U 2"]:
    """The difference between the matrices' rows over the rows' length."""
    length = np.linalg.norm(ours, axis=2)
    return np.linalg.norm(others - ours, axis=2) / np.maximum(length, np.finfo(np.float32).tiny)
