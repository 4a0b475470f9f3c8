"""The project's own dataset format, version 1: names, and JSON in both directions.

A folder holds `dataset.json` (written last, so its presence means that the rest is whole),
`theta.npy` [F, H] float32, `images/%05d.png` RGBA with straight alpha, and `head.npz` only where
the head model is not the embedded one. Cameras in JSON: `world_to_camera` 4 x 4 (OpenCV axes),
`focal_px` [fx, fy], `principal_point_px` [cx, cy]; one for all frames, or one a frame.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels.types import PinholeCameras

FORMAT = "rgbavatar native"
VERSION = 1
INDEX_FILE = "dataset.json"
THETA_FILE = "theta.npy"
HEAD_FILE = "head.npz"
IMAGE_FOLDER = "images"

_CAMERA_SHAPES = {"world_to_camera": (4, 4), "focal_px": (2,), "principal_point_px": (2,)}


def camera_to_json(cameras: PinholeCameras, position: int) -> dict[str, Any]:
    """One camera as JSON; its numbers come back bit for bit."""
    return {name: getattr(cameras, name)[position].tolist() for name in _CAMERA_SHAPES}


def cameras_from_json(records: list[tuple[str, Any]], width: int, height: int) -> PinholeCameras:
    """Cameras of one size from (what to call it in an error, JSON); raises UserError."""
    columns: dict[str, list[Tensor]] = {name: [] for name in _CAMERA_SHAPES}
    for label, record in records:
        for name, shape in _CAMERA_SHAPES.items():
            columns[name].append(_camera_part(label, record, name, shape))
        _check_camera(label, columns["world_to_camera"][-1], columns["focal_px"][-1])
    return PinholeCameras(
        torch.stack(columns["world_to_camera"]),
        torch.stack(columns["focal_px"]),
        torch.stack(columns["principal_point_px"]),
        width,
        height,
    )


def _camera_part(
    label: str, record: Any, name: str, shape: tuple[int, ...]
) -> Float[Tensor, "..."]:
    try:
        value = torch.tensor(record[name], dtype=torch.float32)
    except (KeyError, TypeError, ValueError):
        value = None
    if value is None or tuple(value.shape) != shape or not torch.isfinite(value).all():
        size = " x ".join(map(str, shape))
        raise UserError(
            f"The camera of {label} has no valid {name}: {size} finite numbers are needed.",
            "Write the dataset again with `DatasetWriter`, or mend its dataset.json.",
        )
    return value


def _check_camera(
    label: str, world_to_camera: Float[Tensor, "4 4"], focal_px: Float[Tensor, "2"]
) -> None:
    rotation = world_to_camera[:3, :3].double()
    rigid = torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-3)
    affine = torch.equal(world_to_camera[3], torch.tensor([0.0, 0.0, 0.0, 1.0]))
    if not (rigid and affine and torch.linalg.det(rotation) > 0 and bool((focal_px > 0).all())):
        raise UserError(
            f"The camera of {label} is not a rigid world_to_camera with positive focal lengths.",
            "Give the OpenCV matrix (x right, y down, z forward) without scale or mirroring, and "
            "focal lengths in pixels.",
        )
