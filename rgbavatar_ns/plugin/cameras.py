"""Between the project's cameras (OpenCV, head world) and nerfstudio's (OpenGL, z up)."""

import copy

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.nerfstudio_axes import (
    HEAD_TO_NERFSTUDIO,
    OPENCV_TO_OPENGL,
    world_to_camera_of,
)
from rgbavatar_ns.kernels import PinholeCameras


def head_to_nerfstudio(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Points of the head's world in nerfstudio's world, both in metres."""
    return points @ points.new_tensor(HEAD_TO_NERFSTUDIO).T


def to_nerfstudio(
    cameras: PinholeCameras,
    *,
    theta: Float[Tensor, "C H"],
    position: Float[Tensor, "C 1"],
    times: Float[Tensor, "C"],
) -> Cameras:
    """nerfstudio's cameras of C frames, each carrying its theta and its place in the dataset.

    `position` is kept as a float: nerfstudio moves metadata with the cameras and slices it.
    """
    world_to_camera = cameras.world_to_camera.expand(len(theta), 4, 4)
    camera_to_head = world_to_camera[:, :3, :3].transpose(1, 2)
    turn = world_to_camera.new_tensor(HEAD_TO_NERFSTUDIO)
    centre = -(camera_to_head @ world_to_camera[:, :3, 3:])
    axes = camera_to_head * world_to_camera.new_tensor(OPENCV_TO_OPENGL)
    return Cameras(
        camera_to_worlds=turn @ torch.cat([axes, centre], dim=-1),
        fx=cameras.focal_px[:, :1].expand(len(theta), 1),
        fy=cameras.focal_px[:, 1:].expand(len(theta), 1),
        cx=cameras.principal_point_px[:, :1].expand(len(theta), 1),
        cy=cameras.principal_point_px[:, 1:].expand(len(theta), 1),
        width=cameras.width,
        height=cameras.height,
        camera_type=CameraType.PERSPECTIVE,
        times=times,
        metadata={"theta": theta, "position": position},
    )


def is_perspective(cameras: Cameras) -> bool:
    """Whether nerfstudio's cameras are all of the one kind that can be rendered."""
    return bool((cameras.camera_type == CameraType.PERSPECTIVE.value).all())


def as_perspective(cameras: Cameras) -> Cameras:
    """The same places, directions and focal lengths, as perspective cameras."""
    changed = copy.copy(cameras)
    changed.camera_type = torch.full_like(cameras.camera_type, CameraType.PERSPECTIVE.value)
    return changed


def from_nerfstudio(cameras: Cameras) -> PinholeCameras:
    """The project's cameras of nerfstudio's, one image size for all.

    Raises:
        UserError: the cameras are not perspective, or differ in image size.
    """
    flat = cameras if cameras.shape else cameras.reshape((1,))
    if not is_perspective(flat):
        raise UserError(
            "Only perspective cameras can be rendered.",
            "Choose the camera type 'perspective' in the viewer's render panel or camera path.",
        )
    if flat.is_jagged:
        raise UserError(
            "The cameras of one batch differ in image size.",
            "Bring all images of a dataset to one size before training.",
        )
    world_to_camera = world_to_camera_of(flat.camera_to_worlds)
    return PinholeCameras(
        world_to_camera=world_to_camera,
        # A camera path brings poses and focal lengths in different precision.
        focal_px=torch.cat([flat.fx, flat.fy], dim=-1).to(world_to_camera),
        principal_point_px=torch.cat([flat.cx, flat.cy], dim=-1).to(world_to_camera),
        width=int(flat.width.reshape(-1)[0]),
        height=int(flat.height.reshape(-1)[0]),
    )


def filled_depth(
    depth: Float[Tensor, "B H W 1"], alpha: Float[Tensor, "B H W 1"]
) -> Float[Tensor, "B H W 1"]:
    """Put what is not covered behind everything else, as nerfstudio's compositing expects."""
    return torch.where(alpha > 0.5, depth, depth.amax())
