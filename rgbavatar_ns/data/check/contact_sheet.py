"""Contact sheets: a head mesh drawn over the frames that it was fitted to."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from rgbavatar_ns.data.check.sample import Sample, projected
from rgbavatar_ns.data.check.silhouette import SilhouetteOverlap
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.drawing.wireframe import with_wireframe

_TILE_PX, _COLUMNS, MAX_TILES = 320, 4, 16
_BEHIND = 128


def write_check_sheet(
    path: Path,
    dataset: TrackedDataset,
    sample: Sample,
    overlaps: Sequence[SilhouetteOverlap],
    chosen: Sequence[int],
) -> None:
    """Draw these of the sample's frames beside one another; an existing file is replaced.

    Labels give the frame's number and IoU.
    """
    points = projected(sample)
    tiles = []
    for place in chosen:
        position = sample.positions[place]
        image = dataset.read_image(position)
        zoom = _TILE_PX / max(image.shape[:2])
        faces = sample.faces[points.seen[place][sample.faces].all(1)]
        vertices_px = points.points_px[place] / sample.scale * zoom
        drawn = with_wireframe(over_gray(image, zoom), vertices_px, faces)
        iou = f"  IoU {overlaps[place].iou:.2f}" if overlaps else ""
        tiles.append(labelled(drawn, f"{dataset.frame_index[position]}{iou}"))
    write_contact_sheet(path, tiles)


def write_contact_sheet(path: Path, tiles: Sequence[UInt8[np.ndarray, "h w 3"]]) -> None:
    """Tiles of one size in rows of four, blue first, as a PNG; an existing file is replaced."""
    columns = min(_COLUMNS, len(tiles))
    whole = [*tiles, *[np.zeros_like(tiles[0])] * (-len(tiles) % columns)]
    rows = [np.hstack(whole[start : start + columns]) for start in range(0, len(whole), columns)]
    path.write_bytes(cv2.imencode(".png", np.vstack(rows))[1].tobytes())


def over_gray(image_rgba: UInt8[np.ndarray, "H W 4"], zoom: float) -> UInt8[np.ndarray, "h w 3"]:
    """The image, blue first, over grey where its matte is clear, `zoom` times as large."""
    alpha = image_rgba[..., 3:].astype(np.float32) / 255
    over = image_rgba[..., 2::-1] * alpha + _BEHIND * (1 - alpha)
    size = [max(1, round(side * zoom)) for side in image_rgba.shape[1::-1]]
    method = cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize((over + 0.5).astype(np.uint8), size, interpolation=method))


def labelled(tile_bgr: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "h w 3"]:
    """The tile with white words, edged in black, at its upper left; drawn in place."""
    for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(
            tile_bgr, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, width, cv2.LINE_AA
        )
    return tile_bgr
