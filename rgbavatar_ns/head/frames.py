"""Tangent frames of triangles (paper, Alg. 1) and the rotations that belong to them."""

from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rgbavatar_ns.head.rotations import matrix_to_quat_wxyz

TangentVariant = Literal["normalized", "raw", "orthonormal"]


def tangent_frames(
    vertices: Float[Tensor, "*batch V 3"],
    faces: Int[Tensor, "F 3"],
    uv: Float[Tensor, "VT 2"],
    uv_faces: Int[Tensor, "F 3"],
    variant: TangentVariant = "normalized",
) -> Float[Tensor, "*batch F 3 3"]:
    """Matrices with columns T, B, N of each triangle: along u, along v, outward normal.

    `raw` is Alg. 1: T = dx/du and B = dx/dv in metres a unit of UV, N of length one. (Alg. 1
    prints M where its inverse transpose is meant; only so are T and B the tangents that its text
    describes.) `normalized` scales T and B to length one, as the release does, without making
    them orthogonal. `orthonormal` (ours) keeps N and T's direction and takes B = N x T: a proper
    rotation even where the UV map is mirrored.

    Triangles without area in the UV map take their edges for T and B, triangles without area in
    space take the world's axes: always finite, gradients too.
    """
    corners = vertices.index_select(-2, faces.flatten()).unflatten(-2, (len(faces), 3))
    first = corners[..., 1, :] - corners[..., 0, :]
    second = corners[..., 2, :] - corners[..., 0, :]
    axes = torch.eye(3, dtype=vertices.dtype, device=vertices.device)
    flat = _without_area(first, second)[..., None]
    first, second = torch.where(flat, axes[0], first), torch.where(flat, axes[1], second)
    cross = torch.linalg.cross(first, second, dim=-1)
    normal = cross / torch.linalg.vector_norm(cross, dim=-1, keepdim=True)
    inverse = _uv_inverses(uv, uv_faces).to(vertices.dtype)
    tangent = first * inverse[:, 0, 0, None] + second * inverse[:, 0, 1, None]
    if variant == "orthonormal":
        tangent = tangent / torch.linalg.vector_norm(tangent, dim=-1, keepdim=True)
        bitangent = torch.linalg.cross(normal, tangent, dim=-1)
        return torch.stack([tangent, bitangent, normal], -1)
    bitangent = first * inverse[:, 1, 0, None] + second * inverse[:, 1, 1, None]
    if variant == "normalized":
        tangent = tangent / torch.linalg.vector_norm(tangent, dim=-1, keepdim=True)
        bitangent = bitangent / torch.linalg.vector_norm(bitangent, dim=-1, keepdim=True)
    return torch.stack([tangent, bitangent, normal], -1)


def _without_area(
    first: Float[Tensor, "*batch F 3"], second: Float[Tensor, "*batch F 3"]
) -> Bool[Tensor, "*batch F"]:
    """Whether two edges are (nearly) parallel or have no length."""
    with torch.no_grad():
        a, b = (first * first).sum(-1), (second * second).sum(-1)
        c = (first * second).sum(-1)
        return ~(a * b - c * c > 1e-10 * a * b + 1e-30)


def _uv_inverses(uv: Float[Tensor, "VT 2"], uv_faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 2 2"]:
    """Rows give T and B from the two edges, in float64; the identity where there is no area."""
    corners = uv.double()[uv_faces]
    du, dv = (corners[:, 1:] - corners[:, :1]).unbind(-1)
    det = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    longest = du.square().amax(1) + dv.square().amax(1)
    # Not written as a comparison with zero: rounding of uv to float32 leaves residues.
    flat = ~(det.abs() > 1e-6 * longest + 1e-14)
    rows = torch.stack([dv[:, 1], -dv[:, 0], -du[:, 1], du[:, 0]], -1).unflatten(-1, (2, 2))
    inverse = rows / torch.where(flat, 1.0, det)[:, None, None]
    return torch.where(
        flat[:, None, None], torch.eye(2, dtype=det.dtype, device=uv.device), inverse
    )


def frame_quats_wxyz(frames: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions (real part first) of the proper rotation nearest a tangent frame keeping N.

    T and B of `normalized` and `raw` frames are not orthogonal, so the frame is no rotation. A
    Gaussian needs one: the normal stays, since Gaussians lie on the surface, and within the
    surface's plane the rotation is taken whose axes are nearest to T and B in the least-squares
    sense (both weighted by their length), so that neither direction of the map is preferred. For
    an orthonormal frame it is the frame itself. Where the UV map is mirrored, B is negated first.
    Ours; the paper (sec. 3.1) writes q_D = R q_T without saying how R becomes a rotation.
    """
    tangent, bitangent, normal = frames.unbind(-1)
    # In the plane: turning B back by 90 degrees (B x N) gives a second wish for T's direction.
    turned = torch.linalg.cross(bitangent, normal, dim=-1)
    mirrored = (turned * tangent).sum(-1, keepdim=True) < 0
    wished = tangent + torch.where(mirrored, -turned, turned)
    wished = wished - (wished * normal).sum(-1, keepdim=True) * normal
    along_u = wished / torch.linalg.vector_norm(wished, dim=-1, keepdim=True)
    along_v = torch.linalg.cross(normal, along_u, dim=-1)
    return matrix_to_quat_wxyz(torch.stack([along_u, along_v, normal], -1))
