"""From tangent space to the world: x_D = R x_T + t, q_D = R q_T (paper, supplement)."""

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.anchors import AnchorFrames
from rgbavatar_ns.avatar.blendshapes import TangentGaussians, color_from_feature
from rgbavatar_ns.head.rotations import quat_multiply_wxyz
from rgbavatar_ns.kernels import GaussianSet


def to_world(tangent: TangentGaussians, frames: AnchorFrames) -> GaussianSet:
    """Activate blended Gaussians and put them into the world.

    Positions go through the frame as it is, rotations through its nearest proper rotation that
    keeps the normal. Quaternions are left unnormalised, since the rasterizer normalises them and
    the frame's are unit, so the result is the same as normalising before. Opacities and scales
    are shared by the batch (leading 1), unless scales follow the triangles.
    """
    scales = tangent.log_scale.exp()[None]
    if frames.length_ratio is not None:
        scales = scales * frames.length_ratio.unsqueeze(-1)
    return GaussianSet(
        means=rotate(frames.matrix, tangent.position) + frames.origin,
        quats_wxyz=quat_multiply_wxyz(frames.quat_wxyz, tangent.rotation_wxyz),
        scales=scales,
        opacities=torch.sigmoid(tangent.opacity_logit)[None],
        colors=color_from_feature(tangent.color_feature),
    )


def rotate(
    matrix: Float[Tensor, "B N 3 3"], vector: Float[Tensor, "B N 3"]
) -> Float[Tensor, "B N 3"]:
    """Multiply each vector by its matrix."""
    return torch.einsum("bnij,bnj->bni", matrix, vector)
