"""nerfstudio's axes (its world has z up, its cameras are OpenGL's) in the project's.

The head's world has y up and z out of the face. nerfstudio's viewer has z up, so its world is
the head's turned by a quarter about x: the face looks along -y, the subject's left stays +x.
Both worlds are in metres.
"""

import torch
from jaxtyping import Float
from torch import Tensor

HEAD_TO_NERFSTUDIO = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
"""(x, y, z) of the head's world is (x, -z, y) there."""
OPENCV_TO_OPENGL = (1.0, -1.0, -1.0)


def world_to_camera_of(
    nerfstudio_camera_to_world: Float[Tensor, "C 3 4"],
) -> Float[Tensor, "C 4 4"]:
    """The project's matrices (OpenCV, the head's world) of nerfstudio's cameras."""
    turn = nerfstudio_camera_to_world.new_tensor(HEAD_TO_NERFSTUDIO)
    camera_to_head = turn.T @ nerfstudio_camera_to_world
    axes = camera_to_head[:, :, :3] * turn.new_tensor(OPENCV_TO_OPENGL)
    rotation = axes.transpose(1, 2)
    translation = -(rotation @ camera_to_head[:, :, 3:])
    world_to_camera = torch.cat([rotation, translation], dim=-1)
    last_row = world_to_camera.new_tensor([[[0.0, 0.0, 0.0, 1.0]]]).expand(len(rotation), 1, 4)
    return torch.cat([world_to_camera, last_row], dim=1)
