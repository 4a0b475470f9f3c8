"""The contact sheet of `check`: the head mesh drawn over frames of a dataset."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from rgbavatar_ns.data.check.sample import Sample, projected
from rgbavatar_ns.data.check.silhouette import SilhouetteOverlap
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.drawing.contact_sheet import contact_sheet, labelled, over_gray_bgr
from rgbavatar_ns.drawing.wireframe import with_wireframe
from rgbavatar_ns.files import atomic_write

_TILE_PX, _COLUMNS, MAX_TILES = 320, 4, 16


def write_check_sheet(
    path: Path,
    dataset: TrackedDataset,
    sample: Sample,
    overlaps: Sequence[SilhouetteOverlap],
    chosen: Sequence[int],
) -> None:
    """Draw these of the sample's frames with number and IoU; an existing file is replaced."""
    points = projected(sample)
    tiles = []
    for place in chosen:
        position = sample.positions[place]
        image = dataset.read_image(position)
        zoom = _TILE_PX / max(image.shape[:2])
        faces = sample.faces[points.seen[place][sample.faces].all(1)]
        vertices_px = points.points_px[place] / sample.scale * zoom
        drawn = with_wireframe(over_gray_bgr(image, zoom), vertices_px, faces)
        iou = f"  IoU {overlaps[place].iou:.2f}" if overlaps else ""
        tiles.append(labelled(drawn, f"{dataset.frame_index[position]}{iou}"))
    write_contact_sheet(path, tiles)


def write_contact_sheet(path: Path, tiles: Sequence[UInt8[np.ndarray, "h w 3"]]) -> None:
    """Write tiles, blue first, in rows of four as a PNG; an existing file is replaced."""
    with atomic_write(path) as partial:
        partial.write_bytes(cv2.imencode(".png", contact_sheet(tiles, _COLUMNS))[1].tobytes())
