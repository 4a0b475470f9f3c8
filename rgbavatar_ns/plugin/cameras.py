"""Between the project's cameras (OpenCV, head world) and nerfstudio's (OpenGL, z up).

The head's world has y up and z out of the face. nerfstudio's viewer has z up, so its world is
the head's turned by a quarter about x: the face looks along -y, the subject's left stays +x.
Both worlds are in metres.
"""

import copy

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.views import HEAD_TO_NERFSTUDIO
from rgbavatar_ns.kernels import PinholeCameras

_OPENCV_TO_OPENGL = (1.0, -1.0, -1.0)


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
    axes = camera_to_head * world_to_camera.new_tensor(_OPENCV_TO_OPENGL)
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
    turn = flat.camera_to_worlds.new_tensor(HEAD_TO_NERFSTUDIO)
    camera_to_head = turn.T @ flat.camera_to_worlds
    axes = camera_to_head[:, :, :3] * turn.new_tensor(_OPENCV_TO_OPENGL)
    rotation = axes.transpose(1, 2)
    translation = -(rotation @ camera_to_head[:, :, 3:])
    world_to_camera = torch.cat([rotation, translation], dim=-1)
    last_row = world_to_camera.new_tensor([[[0.0, 0.0, 0.0, 1.0]]]).expand(len(rotation), 1, 4)
    return PinholeCameras(
        world_to_camera=torch.cat([world_to_camera, last_row], dim=1),
        # A camera path brings poses and focal lengths in different precision.
        focal_px=torch.cat([flat.fx, flat.fy], dim=-1).to(rotation),
        principal_point_px=torch.cat([flat.cx, flat.cy], dim=-1).to(rotation),
        width=int(flat.width.reshape(-1)[0]),
        height=int(flat.height.reshape(-1)[0]),
    )


def filled_depth(
    depth: Float[Tensor, "B H W 1"], alpha: Float[Tensor, "B H W 1"]
) -> Float[Tensor, "B H W 1"]:
    """Put what is not covered behind everything else, as nerfstudio's compositing expects."""
    return torch.where(alpha > 0.5, depth, depth.amax())
