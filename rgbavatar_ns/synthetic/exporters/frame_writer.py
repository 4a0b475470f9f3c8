"""metrical-tracker's `.frame` files of a take whose head moves as one piece."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_6d_rows
from rgbavatar_ns.synthetic.exporters.take import (
    Take,
    TakeFrame,
    focal_px,
    principal_point_px,
    rigid_camera,
    root_joint,
)

_TEXTURE = 140


class FrameWriter:
    """Writes `checkpoint/%05d.frame`: the head stands still and the camera moves."""

    def __init__(self, folder: Path, take: Take) -> None:
        self._folder = folder / "checkpoint"
        self._folder.mkdir(parents=True, exist_ok=True)
        self._take = take

    def camera(self, frame: TakeFrame) -> Float[np.ndarray, "4 4"]:
        """World-to-camera as the file has it."""
        take = self._take
        root = root_joint(take.arrays, take.identity, frame.theta["expression"])
        return rigid_camera(frame, root)

    def write(self, frame: TakeFrame) -> None:
        """One frame's file."""
        theta, take = frame.theta, self._take
        matrix = self.camera(frame)
        intrinsics = np.diag([*focal_px(frame), 1.0])
        intrinsics[:2, 2] = principal_point_px(frame)
        eyes = np.concatenate([_rows(theta["left_eye"]), _rows(theta["right_eye"])])
        flame = {
            "exp": theta["expression"],
            "shape": take.identity,
            "tex": np.zeros(_TEXTURE),
            "eyes": eyes,
            "eyelids": theta["eyelids"],
            "jaw": _rows(theta["jaw"]),
        }
        content = {
            "flame": {
                **{name: value[None].astype(np.float32) for name, value in flame.items()},
                "sh": np.zeros((1, 9, 3), np.float32),
            },
            "opencv": {
                "R": matrix[None, :3, :3].astype(np.float32),
                "t": matrix[None, :3, 3].astype(np.float32),
                "K": intrinsics[None].astype(np.float32),
            },
            "img_size": np.array([take.height, take.width]),
            "frame_id": f"{frame.index:05d}",
            "global_step": frame.index,
        }
        torch.save(content, self._folder / f"{frame.index:05d}.frame")


def _rows(axis_angle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6"]:
    return matrix_to_6d_rows(axis_angle_to_matrix(torch.from_numpy(axis_angle))).numpy()
