"""The head at rest spread out over its UV layout: its Gaussians, and the camera that sees them."""

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.head import tangent_frames
from rgbavatar_ns.head.rotations import matrix_to_quat_wxyz, quat_wxyz_to_matrix
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras

_DISTANCE = 256.0
"""Of the camera, in sides of the layout: so far that it sees all straight from above (a Gaussian
a tenth above the layout's edge moves by a fifth of a thousandth), so near that float32 still tells
a hundredth of a texel in height."""


@torch.no_grad()
def unfolded(avatar: Avatar) -> GaussianSet:
    """Return the head's Gaussians at rest, each carried by its triangle to the UV layout.

    One set. x = u - 1/2 and y = 1/2 - v, z is the height above the surface, downwards from the
    camera of `unfolded_view`; heights are measured as lengths in the triangle are. Ours.
    """
    rest = avatar.identity.new_zeros(1, avatar.layout.size)
    gaussians, vertices = avatar.gaussians(rest), avatar.carrier_vertices(rest)
    head, anchors = avatar.head, avatar.anchors
    frames = tangent_frames(vertices, head.faces, head.uv, head.uv_faces, variant="raw")[0]
    along_u, along_v, normal = frames.unbind(-1)
    side_m = torch.linalg.cross(along_u, along_v).norm(dim=-1, keepdim=True).sqrt()
    to_layout = torch.linalg.inv(torch.stack([along_u, along_v, side_m * normal], -1))
    # From u, v and height to right, down and away.
    flip = to_layout.new_tensor([1.0, -1.0, -1.0])
    linear = (flip[:, None] * to_layout)[anchors.triangle_index]
    offset = gaussians.means[0] - anchors.origins(vertices)[0]
    corners = head.uv.to(linear)[head.uv_faces[anchors.triangle_index]]
    u, v = (corners * anchors.barycentric[..., None]).sum(1).unbind(-1)
    place = torch.stack([u - 0.5, 0.5 - v, torch.full_like(u, _DISTANCE)], -1)
    quats_wxyz, scales = _ellipsoids(linear, gaussians)
    return GaussianSet(
        means=(place + (linear @ offset[..., None])[..., 0])[None],
        quats_wxyz=quats_wxyz,
        scales=scales,
        opacities=gaussians.opacities,
        colors=gaussians.colors,
    )


def _ellipsoids(
    linear: Float[Tensor, "N 3 3"], gaussians: GaussianSet
) -> tuple[Float[Tensor, "1 N 4"], Float[Tensor, "1 N 3"]]:
    """Orientations and standard deviations of Gaussians that a linear map has deformed."""
    rotation = quat_wxyz_to_matrix(gaussians.quats_wxyz[0])
    # The square root of the covariance: its left singular vectors are the new axes.
    axes, scales, _ = torch.linalg.svd(linear @ (rotation * gaussians.scales[0][:, None, :]))
    proper = axes * torch.linalg.det(axes).sign()[:, None, None]
    return matrix_to_quat_wxyz(proper)[None], scales[None]


def unfolded_view(side_px: int, like: Tensor) -> PinholeCameras:
    """Return the camera that sees the whole layout, v upwards, in a square picture."""
    return PinholeCameras(
        world_to_camera=torch.eye(4).to(like)[None],
        focal_px=torch.full((1, 2), side_px * _DISTANCE).to(like),
        principal_point_px=torch.full((1, 2), side_px / 2).to(like),
        width=side_px,
        height=side_px,
    )
