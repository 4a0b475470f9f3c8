"""Where the head's motion goes: as it came, into the camera, or into the head or its neck."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from rgbavatar_ns.data.importers.frame_record import FrameRecord
from rgbavatar_ns.data.importers.options import HeadPose
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.joints import NECK, ROOT
from rgbavatar_ns.head.layout import RIGID_FIELDS
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle

Rigid = Float[np.ndarray, "4 4"]
_STILL = 1e-5


def all_is_the_cameras(records: Sequence[FrameRecord]) -> bool:
    """Whether one camera moves about a head that never turns or moves."""
    first = records[0].camera.world_to_camera
    still = not any(
        record.theta[name].any()
        for record in records
        for name in RIGID_FIELDS
        if name in record.theta
    )
    one = len({record.camera_name for record in records}) == 1
    moves = any(np.abs(record.camera.world_to_camera - first).max() > _STILL for record in records)
    return still and one and moves


def place_head_pose(
    records: Sequence[FrameRecord],
    arrays: HeadArrays,
    identity: Float[np.ndarray, "I"],
    head_pose: HeadPose,
) -> list[FrameRecord]:
    """The same pictures with the head's rigid motion elsewhere.

    camera and head are exact: every vertex stays where it was in every image. neck (method of
    RGBAvatar's release) is exact for what follows the neck alone; the collar takes part in the
    shift only. Raises UserError where several cameras move.
    """
    if head_pose == "source":
        return list(records)
    joints = _joints(records, arrays, identity)
    still = {} if head_pose == "camera" else _still_cameras(records)
    placed = []
    for record, (root, neck) in zip(records, joints):
        motion = _body_motion(record, root)
        if head_pose == "camera":
            moved = {"rotation": np.zeros(3), "translation": np.zeros(3)}
            matrix = record.camera.world_to_camera @ motion
        else:
            matrix = still[record.camera_name]
            motion = np.linalg.inv(matrix) @ record.camera.world_to_camera @ motion
            turn, shift = motion[:3, :3], motion[:3, 3]
            if head_pose == "head":
                joint, moved = root, {"rotation": _axis_angle(turn)}
            else:
                # The neck turns first and then the body: together R_body R_neck.
                own = _matrix(record.theta.get("neck", np.zeros(3)))
                joint, moved = neck, {"rotation": np.zeros(3), "neck": _axis_angle(turn @ own)}
            moved["translation"] = shift + turn @ joint - joint
        camera = replace(record.camera, world_to_camera=matrix)
        placed.append(replace(record, theta={**record.theta, **moved}, camera=camera))
    return placed


def _body_motion(record: FrameRecord, root: Float[np.ndarray, "3"]) -> Rigid:
    """What theta's rotation about the root joint and its translation do to the whole head."""
    zero = np.zeros(3)
    turn = _matrix(record.theta.get("rotation", zero))
    motion = np.eye(4)
    motion[:3, :3] = turn
    motion[:3, 3] = root - turn @ root + record.theta.get("translation", zero)
    return motion


def _still_cameras(records: Sequence[FrameRecord]) -> dict[str | None, Rigid]:
    """Each camera as its first frame has it."""
    first: dict[str | None, Rigid] = {}
    moves = False
    for record in records:
        matrix = record.camera.world_to_camera
        known = first.setdefault(record.camera_name, matrix)
        moves |= bool(np.abs(known - matrix).max() > _STILL)
    if moves and len(first) > 1:
        raise UserError(
            f"The {len(first)} cameras move, so the head's motion cannot be taken from them.",
            "Import with --head-pose source or camera.",
        )
    return first


def _joints(
    records: Sequence[FrameRecord], arrays: HeadArrays, identity: Float[np.ndarray, "I"]
) -> Float[np.ndarray, "F 2 3"]:
    """Root and neck of each frame's expression at rest."""
    regressor = arrays.joint_regressor[[ROOT, NECK]].astype(np.float64)
    count = arrays.num_identity
    shapedirs = arrays.shapedirs.astype(np.float64)
    rest = regressor @ (arrays.v_template + shapedirs[..., :count] @ identity)
    moves = np.einsum("jv,vxc->jxc", regressor, shapedirs[..., count:])
    zero = np.zeros(arrays.num_expressions)
    expressions = np.stack([record.theta.get("expression", zero) for record in records])
    return rest + np.einsum("jxc,fc->fjx", moves, expressions)


def _matrix(axis_angle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return axis_angle_to_matrix(torch.from_numpy(axis_angle)).numpy()


def _axis_angle(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    return matrix_to_axis_angle(torch.from_numpy(matrix)).numpy()
