"""A contact sheet: the fitted mesh and the landmarks drawn over frames of the clip."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from rgbavatar_ns.drawing.wireframe import fixed_point, with_wireframe

_TILE_PX = 384
_FOUND_BGR, _FITTED_BGR = (80, 255, 80), (60, 60, 255)


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
    columns = min(columns, len(pairs))
    blank = np.zeros_like(pairs[0])
    rows = [pairs[start : start + columns] for start in range(0, len(pairs), columns)]
    rows[-1] += [blank] * (columns - len(rows[-1]))
    sheet = np.vstack([np.hstack(row) for row in rows])
    path.write_bytes(cv2.imencode(".png", sheet)[1].tobytes())


def _draw(tile: OverlayTile, faces: Int[np.ndarray, "T 3"]) -> UInt8[np.ndarray, "h w 3"]:
    scale = _TILE_PX / tile.image_rgba.shape[0]
    color = tile.image_rgba[..., 2::-1].astype(np.float32)
    alpha = tile.image_rgba[..., 3:].astype(np.float32) / 255
    matted = (color * alpha + 128 * (1 - alpha) + 0.5).astype(np.uint8)
    picture = cv2.resize(matted, (_TILE_PX, _TILE_PX), interpolation=cv2.INTER_CUBIC)
    drawn = with_wireframe(picture, tile.vertices_px * scale, faces)
    for points, bgr in ((tile.found_px, _FOUND_BGR), (tile.fitted_px, _FITTED_BGR)):
        for point in fixed_point(points * scale):
            cv2.circle(drawn, (int(point[0]), int(point[1])), 20, bgr, -1, cv2.LINE_AA, shift=4)
    for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(
            *(drawn, tile.label, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, width, cv2.LINE_AA)
        )
    return np.hstack([picture, drawn])
