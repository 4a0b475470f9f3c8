"""Cameras to look at an avatar with: fixed views, nerfstudio's camera paths."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.nerfstudio_axes import world_to_camera_of
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.reading import DamagedFileError, json_numbers, load_json

FOUR_VIEWS_DEGREES = ((-40.0, 0.0), (40.0, 0.0), (0.0, -20.0), (0.0, 20.0))
"""(yaw, pitch) of the novel views: the head seen from its right, its left, above and below. The
paper shows four without saying which."""

_DISTANCE_M = 1.1
_SEEN_M = 0.34
_MOST_CAMERAS, _LARGEST_SIDE, _MOST_FRAMES_PER_SECOND = 100_000, 16384, 1000.0


@torch.no_grad()
def front_camera(avatar: AvatarMethod, width: int, height: int) -> PinholeCameras:
    """A camera 1.1 m in front of the face that sees the whole head."""
    rest = avatar.identity.new_zeros(1, avatar.layout.size)
    x, y, z = avatar.head(rest, avatar.identity)[0].mean(0).tolist()
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None]
    world_to_camera[0, :3, 3] = torch.tensor([-x, y, z + _DISTANCE_M])
    focal_px = torch.full((1, 2), min(width, height) * _DISTANCE_M / _SEEN_M)
    centre_px = torch.tensor([[width / 2, height / 2]])
    return PinholeCameras(world_to_camera, focal_px, centre_px, width, height)


def resized(cameras: PinholeCameras, width: int, height: int) -> PinholeCameras:
    """The same cameras for pictures of another size; what they saw fits into its middle."""
    zoom = min(width / cameras.width, height / cameras.height)
    old = torch.tensor([cameras.width, cameras.height]).to(cameras.focal_px)
    new = torch.tensor([width, height]).to(cameras.focal_px)
    principal_px = new / 2 + (cameras.principal_point_px - old / 2) * zoom
    return PinholeCameras(
        cameras.world_to_camera, cameras.focal_px * zoom, principal_px, width, height
    )


def read_camera_path(path: Path) -> tuple[PinholeCameras, float]:
    """Cameras and frames per second of a camera path written by nerfstudio's viewer.

    Raises UserError where the file is none, or not of perspective cameras.
    """
    try:
        described = load_json(path)
        listed = described["camera_path"]
        size = json_numbers([described["render_width"], described["render_height"]], (2,))
        kind = described.get("camera_type", "perspective")
        poses = [json_numbers(entry["camera_to_world"], (16,)) for entry in listed]
        fov_degrees = json_numbers([entry["fov"] for entry in listed], (len(listed),))
        # A path without a rate says how long it is.
        (rate,) = json_numbers([described["fps" if "fps" in described else "seconds"]], (1,))
        frames_per_second = rate if "fps" in described else len(listed) / max(rate, 1e-3)
        if not all(1 <= side <= _LARGEST_SIDE for side in size) or len(listed) > _MOST_CAMERAS:
            raise DamagedFileError(f"it is of {len(listed)} pictures of {size[0]:g} x {size[1]:g}")
        if not 0 < frames_per_second <= _MOST_FRAMES_PER_SECOND:
            raise DamagedFileError(f"it is of {frames_per_second:g} frames per second")
        if not ((fov_degrees > 0) & (fov_degrees < 180)).all():
            raise DamagedFileError("it has angles of view outside of 0 to 180 degrees")
    except (DamagedFileError, KeyError, TypeError, AttributeError) as error:
        told = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise UserError(
            f"{path} is no camera path of nerfstudio's viewer: {told}.",
            "Save one with 'Generate Command' in the viewer's render panel.",
        ) from None
    if kind != "perspective" or not listed:
        raise UserError(
            f"The camera path {path} has {len(listed)} cameras of the type '{kind}'.",
            "Choose the type 'perspective' in the viewer's render panel and add cameras.",
        )
    width, height = map(int, size)
    camera_to_world = torch.from_numpy(np.stack(poses)).float().reshape(-1, 4, 4)
    fov = torch.from_numpy(fov_degrees).float().deg2rad()
    # The field of view is the vertical one.
    focal_px = 0.5 * height / torch.tan(0.5 * fov)
    principal = torch.tensor([width / 2, height / 2]).expand(len(fov), 2)
    world_to_camera = world_to_camera_of(camera_to_world[:, :3])
    cameras = PinholeCameras(
        world_to_camera, focal_px[:, None].expand(-1, 2), principal, width, height
    )
    return cameras, float(frames_per_second)


def swing(num_frames: int) -> Float[Tensor, "num_frames"]:
    """Between -1 and 1 and back: a calm swing to both sides that ends where it began."""
    return (torch.arange(num_frames) * (2 * math.pi / num_frames)).sin()
