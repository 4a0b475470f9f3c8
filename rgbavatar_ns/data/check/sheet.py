"""A contact sheet: the head mesh drawn over frames of a dataset, with each frame's overlap."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from rgbavatar_ns.data.check.sample import Agreement, Sample, projected
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.drawing.wireframe import with_wireframe

_TILE_PX, _COLUMNS, MAX_TILES = 320, 4, 16
_BEHIND = 128


def write_sheet(
    path: Path,
    dataset: TrackedDataset,
    sample: Sample,
    agreements: Sequence[Agreement],
    chosen: Sequence[int],
) -> None:
    """Draw these of the sample's frames beside one another; an existing file is replaced.

    The picture stands over grey where its matte is clear. Labels give the frame's number and IoU.
    """
    points = projected(sample)
    tiles = []
    for place in chosen:
        position = sample.positions[place]
        image = dataset.read_image(position)
        zoom = _TILE_PX / max(image.shape[:2])
        picture = _over_gray(image, zoom)
        seen = points.seen[place][sample.faces].all(1)
        drawn = with_wireframe(
            picture, points.points_px[place] / sample.scale * zoom, sample.faces[seen]
        )
        iou = f"  IoU {agreements[place].iou:.2f}" if agreements else ""
        tiles.append(_labelled(drawn, f"{dataset.frame_index[position]}{iou}"))
    blank = np.zeros_like(tiles[0])
    columns = min(_COLUMNS, len(tiles))
    tiles += [blank] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[start : start + columns]) for start in range(0, len(tiles), columns)]
    path.write_bytes(cv2.imencode(".png", np.vstack(rows))[1].tobytes())


def _over_gray(image_rgba: UInt8[np.ndarray, "H W 4"], zoom: float) -> UInt8[np.ndarray, "h w 3"]:
    alpha = image_rgba[..., 3:].astype(np.float32) / 255
    over = image_rgba[..., 2::-1] * alpha + _BEHIND * (1 - alpha)
    size = [max(1, round(side * zoom)) for side in image_rgba.shape[1::-1]]
    method = cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize((over + 0.5).astype(np.uint8), size, interpolation=method))


def _labelled(picture: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "h w 3"]:
    for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(
            picture, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, width, cv2.LINE_AA
        )
    return picture


def spread(count: int, wanted: int) -> Int[np.ndarray, "n"]:
    """At most `wanted` places of `count`, evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(np.int64))
