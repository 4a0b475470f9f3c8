"""The project's own dataset format, versions 1 to 3: names, and JSON in both directions.

docs/dataset_format.md describes every field. `dataset.json` is written last, so its presence means
that the rest is whole. A dataset is written as the lowest version that has what it needs.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels.types import PinholeCameras
from rgbavatar_ns.reading import DamagedFileError, json_numbers

FORMAT = "rgbavatar native"
VERSIONS = (1, 2, 3)
INDEX_FILE = "dataset.json"
THETA_FILE = "theta.npy"
HEAD_FILE = "head.npz"
IMAGE_FOLDER = "images"

_CAMERA_SHAPES = {"world_to_camera": (4, 4), "focal_px": (2,), "principal_point_px": (2,)}


def image_path(dataset: Path, index: int) -> Path:
    """Where a frame's image lies in a dataset's folder."""
    return dataset / IMAGE_FOLDER / f"{index:05d}.png"


def camera_to_json(cameras: PinholeCameras, position: int) -> dict[str, Any]:
    """One camera as JSON; its numbers come back bit for bit."""
    return {name: getattr(cameras, name)[position].tolist() for name in _CAMERA_SHAPES}


def cameras_from_json(
    records: Sequence[tuple[str, Any]], width: int, height: int
) -> PinholeCameras:
    """Cameras of one size from (what to call it in an error, JSON); raises UserError."""
    columns = {
        name: np.stack([_camera_part(label, record, name, shape) for label, record in records])
        for name, shape in _CAMERA_SHAPES.items()
    }
    _check_cameras(records, columns["world_to_camera"], columns["focal_px"])
    return PinholeCameras(
        **{name: torch.from_numpy(values) for name, values in columns.items()},
        width=width,
        height=height,
    )


def _camera_part(
    label: str, record: Any, name: str, shape: tuple[int, ...]
) -> Float[np.ndarray, "..."]:
    try:
        given = record.get(name) if isinstance(record, dict) else None
        return json_numbers(given, shape).astype(np.float32)
    except DamagedFileError:
        size = " x ".join(map(str, shape))
        raise UserError(
            f"The camera of {label} has no valid {name}: {size} finite numbers are needed.",
            "Write the dataset again with `DatasetWriter`, or mend its dataset.json.",
        ) from None


def _check_cameras(
    records: Sequence[tuple[str, Any]],
    world_to_camera: Float[np.ndarray, "C 4 4"],
    focal_px: Float[np.ndarray, "C 2"],
) -> None:
    rotation = world_to_camera[:, :3, :3].astype(np.float64)
    error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    good = (error < 1e-3) & (np.linalg.det(rotation) > 0) & (focal_px > 0).all(1)
    good &= (world_to_camera[:, 3] == [0, 0, 0, 1]).all(1)
    if not good.all():
        raise UserError(
            f"The camera of {records[int(np.argmin(good))][0]} is not a rigid world_to_camera "
            "with positive focal lengths.",
            "Give the OpenCV matrix (x right, y down, z forward) without scale or mirroring, and "
            "focal lengths in pixels.",
        )
