"""Cameras carried around a head."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.head.joints import ROOT
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.kernels import PinholeCameras


@torch.no_grad()
def head_centre(avatar: AvatarMethod, theta: Float[Tensor, "F H"]) -> Float[Tensor, "F 3"]:
    """The middle of the posed head's box, without what the neck does not turn; in metres."""
    vertices = avatar.head(theta.to(avatar.identity), avatar.identity).cpu()
    head = vertices[:, torch.from_numpy(avatar.head.arrays.skinning_weights[:, ROOT] < 0.5)]
    return (head.amin(1) + head.amax(1)) / 2


def orbit(
    cameras: PinholeCameras,
    centre: Float[Tensor, "#C 3"],
    yaw_degrees: Float[Tensor, "C"],
    pitch_degrees: Float[Tensor, "C"],
) -> PinholeCameras:
    """Cameras (one for all angles, or one each) carried around a point, at the same distance.

    Positive yaw shows the head's left side, positive pitch looks from below. Angles of zero give
    the camera itself; the point stays where it is in the picture.
    """
    yaw, pitch = yaw_degrees.deg2rad(), pitch_degrees.deg2rad()
    zero = torch.zeros_like(yaw)
    about_x = axis_angle_to_matrix(torch.stack([-pitch, zero, zero], -1))
    about_y = axis_angle_to_matrix(torch.stack([zero, -yaw, zero], -1))
    world_to_camera = cameras.world_to_camera.expand(len(yaw), 4, 4).clone()
    rotation, translation = world_to_camera[:, :3, :3], world_to_camera[:, :3, 3]
    turned = rotation @ about_x @ about_y
    moved = translation + ((rotation - turned) @ centre[..., None])[..., 0]
    world_to_camera[:, :3, 3], world_to_camera[:, :3, :3] = moved, turned
    places = range(len(yaw)) if len(cameras.focal_px) > 1 else [0] * len(yaw)
    return replace(cameras.select(places), world_to_camera=world_to_camera)
