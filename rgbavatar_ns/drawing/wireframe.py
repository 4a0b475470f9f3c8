"""A projected mesh as a picture: its silhouette and its wires."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

_WIRE_BGR = (255, 200, 80)


def mesh_silhouette(
    vertices_px: Float[np.ndarray, "V 2"], faces: Int[np.ndarray, "T 3"], size: int
) -> Float[np.ndarray, "size size"]:
    """1 where a triangle that faces the camera covers the pixel's centre, 0 elsewhere."""
    mask = np.zeros((size, size), np.float32)
    corners = vertices_px.astype(np.float32)[faces]
    corners = corners[facing_triangles(corners)]
    first = np.ceil(np.clip(corners.min(1) - 0.5, 0, size)).astype(np.int32)
    last = np.floor(np.clip(corners.max(1) - 0.5, -1, size - 1)).astype(np.int32)
    span = (last - first).max(1, initial=-1) + 1
    span[(last < first).any(1)] = 0
    reach, done = 0, np.zeros(len(span), bool)
    while not (done | (span <= 0)).all():
        reach = 2 * reach or 2
        now = (span > 0) & (span <= reach) & ~done
        done |= now
        _fill(mask, corners[now], first[now], reach)
    return mask


def _fill(
    mask: Float[np.ndarray, "size size"],
    corners: Float[np.ndarray, "T 3 2"],
    first: Int[np.ndarray, "T 2"],
    reach: int,
) -> None:
    """Mark the pixels of boxes of `reach` pixels from `first` (column, row) that lie inside."""
    rows, columns = (part.reshape(1, -1) for part in np.mgrid[0:reach, 0:reach].astype(np.int32))
    columns, rows = first[:, :1] + columns, first[:, 1:] + rows
    x, y = columns.astype(np.float32) + 0.5, rows.astype(np.float32) + 0.5
    inside = (columns < len(mask)) & (rows < len(mask))
    for start, end in ((0, 1), (1, 2), (2, 0)):
        from_x, from_y = corners[:, start, :1], corners[:, start, 1:]
        edge_x, edge_y = corners[:, end, :1] - from_x, corners[:, end, 1:] - from_y
        inside &= y * edge_x - x * edge_y <= from_y * edge_x - from_x * edge_y
    mask[rows[inside], columns[inside]] = 1


def facing_triangles(corners_px: Float[np.ndarray, "T 3 2"]) -> Bool[np.ndarray, "T"]:
    """Triangles seen from outside: wound counterclockwise as seen, with y down."""
    a, b, c = corners_px[:, 0], corners_px[:, 1], corners_px[:, 2]
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def with_wireframe(
    picture_bgr: UInt8[np.ndarray, "H W 3"],
    vertices_px: Float[np.ndarray, "V 2"],
    faces: Int[np.ndarray, "T 3"],
) -> UInt8[np.ndarray, "H W 3"]:
    """A copy of the picture under the translucent edges of the triangles that face the camera."""
    corners = vertices_px.astype(np.float64)[faces]
    outline = fixed_point(corners[facing_triangles(corners)])
    drawn = cv2.polylines(picture_bgr.copy(), list(outline), True, _WIRE_BGR, 1, cv2.LINE_AA, 4)
    return np.asarray(cv2.addWeighted(drawn, 0.35, picture_bgr, 0.65, 0))


def fixed_point(points_px: Float[np.ndarray, "*batch 2"]) -> Int[np.ndarray, "*batch 2"]:
    """Points as OpenCV draws them with shift 4, which counts from the first pixel's centre."""
    return np.round((points_px - 0.5) * 16).astype(np.int32)
