"""From tangent space to the world: x_D = R x_T + t, q_D = R q_T (paper, supplement)."""

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.model.anchors import AnchorFrames
from rgbavatar_ns.avatar.model.blendshapes import TangentGaussians, color_from_feature
from rgbavatar_ns.head.rotations import multiply_quats_wxyz
from rgbavatar_ns.kernels import GaussianSet


def carried(
    position: Float[Tensor, "#B N 3"],
    rotation_wxyz: Float[Tensor, "#B N 4"],
    log_scale: Float[Tensor, "#B N 3"],
    frames: AnchorFrames,
) -> tuple[Float[Tensor, "B N 3"], Float[Tensor, "B N 4"], Float[Tensor, "#B N 3"]]:
    """Means, quaternions (wxyz) and scales in the world of Gaussians that are given in frames.

    Quaternions are left unnormalised, since the rasterizer normalises them. Scales stay shared by
    the batch (leading 1), unless they follow the triangles.
    """
    scales = log_scale.exp()
    if frames.length_ratio is not None:
        scales = scales * frames.length_ratio.unsqueeze(-1)
    means = torch.einsum("bnij,bnj->bni", frames.matrix, position) + frames.origin
    return means, multiply_quats_wxyz(frames.quat_wxyz, rotation_wxyz), scales


def tangent_to_world(tangent: TangentGaussians, frames: AnchorFrames) -> GaussianSet:
    """Activate blended Gaussians and put them into the world; opacities are shared by the batch."""
    means, quats_wxyz, scales = carried(
        tangent.position, tangent.rotation_wxyz, tangent.log_scale[None], frames
    )
    return GaussianSet(
        means=means,
        quats_wxyz=quats_wxyz,
        scales=scales,
        opacities=torch.sigmoid(tangent.opacity_logit)[None],
        colors=color_from_feature(tangent.color_feature),
    )
