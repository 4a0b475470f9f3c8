"""A driver's performance so that the avatar's head is seen as the driver's was.

Where a head is and how it is turned has a meaning only together with a camera. Imported films of
one moving camera count the head's pose from their own first frame, tracked ones from their own
camera, and films of several cameras have one for each frame. So neither the driver's theta before
the avatar's camera nor departures from both neutrals are the driver's pose: both add a constant
that is nobody's turn. What both sides share is the head as its camera saw it.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.driving.theta_map import MappedTheta
from rgbavatar_ns.head import HeadModel, ThetaLayout, turn_seen
from rgbavatar_ns.head.joints import LEFT_EYE, RIGHT_EYE
from rgbavatar_ns.head.layout import CARRIER_FIELDS, RIGID_FIELDS
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rgbavatar_ns.kernels import PinholeCameras

_EYEBALLS = [RIGHT_EYE, LEFT_EYE]
"""Joints of the subject's right eye (the image's left) and of the left one."""
_STILL = 1e-5


@torch.no_grad()
def eyeballs(
    head: HeadModel, identity: Float[Tensor, "I"], theta: Float[Tensor, "F H"]
) -> Float[Tensor, "F 2 3"]:
    """Centres of the posed eyeballs in metres, the subject's right one first."""
    regressor = torch.from_numpy(head.arrays.joint_regressor[_EYEBALLS]).to(theta)
    return torch.einsum("jv,fvc->fjc", regressor, head(theta, identity.to(theta)))


@torch.no_grad()
def eyes_px(
    head: HeadModel,
    identity: Float[Tensor, "I"],
    theta: Float[Tensor, "F H"],
    cameras: PinholeCameras,
) -> Float[np.ndarray, "F 2 2"]:
    """The eyeballs' centres in pixels, the subject's right eye (the image's left) first.

    In pixel indices, as OpenCV counts: the first pixel's centre is 0.
    """
    return (cameras.project(eyeballs(head, identity, theta)) - 0.5).double().numpy()


@torch.no_grad()
def as_seen(
    mapped: MappedTheta,
    avatar: AvatarMethod,
    own: TrackedDataset,
    driver: TrackedDataset,
    chosen: list[int],
) -> tuple[Float[Tensor, "F H"], PinholeCameras]:
    """Theta and a camera for each chosen frame: the avatar's head turned as the driver's was seen.

    Exactly so turned, and with the point between its eyes where the driver's was before the
    camera; as large as the avatar's own metres make it. Pictures have the driver's size and lens.
    Where the avatar's film has the head's motion in theta, theta's turn counts from that film's
    camera, since its weight network has learnt no other; else theta's stays at rest and the camera
    turns. `mapped` holds the chosen frames only. Source: ours, the paper does not say.
    """
    cameras = driver.cameras.select(chosen)
    world_to_camera, performed = cameras.world_to_camera, driver.theta[chosen]
    turn = world_to_camera[:, :3, :3] @ _head_turn(performed, driver.layout)
    between = eyeballs(HeadModel(driver.arrays), driver.identity, performed).mean(1, keepdim=True)
    place = cameras.placed(between)[:, 0]
    theta = mapped.theta.clone()
    rest = own.theta[list(own.train)]
    layout = avatar.layout
    if _turns(rest, layout):
        view = _frontal_view(own)
        _count_from(theta, layout, mapped, view, turn)
        middle = eyeballs(avatar.head, avatar.identity, theta).mean(1)
        where = layout.slice("translation")
        if bool(mapped.known[where].all()):
            theta[:, where] += (place - view[:3, 3]) @ view[:3, :3] - middle
    else:
        for name in RIGID_FIELDS:
            theta[:, layout.slice(name)] = rest[0, layout.slice(name)]
    own_turn = _head_turn(theta, layout)
    middle = eyeballs(avatar.head, avatar.identity, theta).mean(1)
    seen_by = torch.eye(4).to(world_to_camera).repeat(len(theta), 1, 1)
    seen_by[:, :3, :3] = turn @ own_turn.mT
    seen_by[:, :3, 3] = place - (seen_by[:, :3, :3] @ middle[..., None])[..., 0]
    return theta, replace(cameras, world_to_camera=seen_by)


def _head_turn(theta: Float[Tensor, "F H"], layout: ThetaLayout) -> Float[Tensor, "F 3 3"]:
    """How root and neck together have turned the head."""
    root, neck = (axis_angle_to_matrix(theta[:, layout.slice(name)]) for name in CARRIER_FIELDS)
    return root @ neck


def _turns(theta: Float[Tensor, "F H"], layout: ThetaLayout) -> bool:
    """Whether root or neck ever move."""
    numbers = torch.cat([theta[:, layout.slice(name)] for name in CARRIER_FIELDS], 1)
    return bool((numbers - numbers[0]).abs().max() > _STILL)


def _frontal_view(own: TrackedDataset) -> Float[Tensor, "4 4"]:
    """The film's camera; of several the one that saw the head most from the front."""
    train = list(own.train)
    matrices = own.cameras.world_to_camera[train]
    turned = turn_seen(own.theta[train], matrices, own.layout)[:, :2].norm(dim=1)
    different, which = torch.unique(matrices, dim=0, return_inverse=True)
    means = [float(turned[which == place].mean()) for place in range(len(different))]
    return different[int(np.argmin(means))]


def _count_from(
    theta: Float[Tensor, "F H"],
    layout: ThetaLayout,
    mapped: MappedTheta,
    view: Float[Tensor, "4 4"],
    turn: Float[Tensor, "F 3 3"],
) -> None:
    """Let the joint that the driver moves turn the head so that `view` sees `turn`."""
    numbers = {name: layout.slice(name) for name in CARRIER_FIELDS}
    root, neck = (axis_angle_to_matrix(theta[:, numbers[name]]) for name in CARRIER_FIELDS)
    wanted = view[:3, :3].T @ turn
    if bool(mapped.known[numbers["rotation"]].all()):
        theta[:, numbers["rotation"]] = matrix_to_axis_angle(wanted @ neck.mT)
    else:
        theta[:, numbers["neck"]] = matrix_to_axis_angle(root.mT @ wanted)
