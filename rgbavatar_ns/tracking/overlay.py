"""A contact sheet: the fitted mesh and the landmarks drawn over frames of the clip."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

_TILE_PX = 384
_MESH_BGR, _FOUND_BGR, _FITTED_BGR = (255, 200, 80), (80, 255, 80), (60, 60, 255)


@dataclass(frozen=True)
class OverlayTile:
    """One frame of the sheet: crop, projected mesh, observed and fitted landmarks, in pixels."""

    label: str
    image_rgba: UInt8[np.ndarray, "S S 4"]
    vertices_px: Float[np.ndarray, "V 2"]
    found_px: Float[np.ndarray, "L 2"]
    fitted_px: Float[np.ndarray, "L 2"]


def write_contact_sheet(
    path: Path, tiles: Sequence[OverlayTile], faces: Int[np.ndarray, "T 3"], columns: int = 4
) -> None:
    """Per frame a pair: the matted picture, and it with the mesh (blue), found (green) and
    fitted (red) landmarks."""
    pairs = [_draw(tile, faces) for tile in tiles]
    blank = np.zeros_like(pairs[0])
    rows = [pairs[start : start + columns] for start in range(0, len(pairs), columns)]
    rows[-1] += [blank] * (columns - len(rows[-1]))
    cv2.imwrite(str(path), np.vstack([np.hstack(row) for row in rows]))


def _draw(tile: OverlayTile, faces: Int[np.ndarray, "T 3"]) -> UInt8[np.ndarray, "h w 3"]:
    scale = _TILE_PX / tile.image_rgba.shape[0]
    color = tile.image_rgba[..., 2::-1].astype(np.float32)
    alpha = tile.image_rgba[..., 3:].astype(np.float32) / 255
    matted = (color * alpha + 128 * (1 - alpha) + 0.5).astype(np.uint8)
    picture = cv2.resize(matted, (_TILE_PX, _TILE_PX), interpolation=cv2.INTER_CUBIC)
    drawn = picture.copy()
    corners = tile.vertices_px[faces]
    edge_a, edge_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    facing = edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0] < 0
    outline = _fixed(corners[facing] * scale)
    cv2.polylines(drawn, list(outline), True, _MESH_BGR, 1, cv2.LINE_AA, shift=4)
    drawn = cv2.addWeighted(drawn, 0.35, picture, 0.65, 0)
    for points, bgr in ((tile.found_px, _FOUND_BGR), (tile.fitted_px, _FITTED_BGR)):
        for point in _fixed(points * scale):
            cv2.circle(drawn, (int(point[0]), int(point[1])), 20, bgr, -1, cv2.LINE_AA, shift=4)
    cv2.putText(drawn, tile.label, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1)
    return np.hstack([picture, drawn])


def _fixed(points: Float[np.ndarray, "*batch 2"]) -> Int[np.ndarray, "*batch 2"]:
    return np.round((points - 0.5) * 16).astype(np.int32)
