"""Tangent frames of triangles (paper, Alg. 1) and the rotations that belong to them."""

from typing import Literal, TypeAlias

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.head.rotations import matrix_to_quat_wxyz

TangentVariant = Literal["normalized", "raw", "orthonormal"]

_Planes: TypeAlias = tuple[Tensor, ...]
"""x, y and z of many vectors, each [*batch, F]."""


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
    first, second = _wide_edges(vertices, faces)
    normal = _scaled_to_one(_cross(first, second))
    inverse = edges_to_frame(uv, uv_faces).to(vertices.dtype)

    def derivative(row: Float[Tensor, "F 2"]) -> _Planes:
        return tuple(a * row[:, 0] + b * row[:, 1] for a, b in zip(first, second))

    tangent = derivative(inverse[:, 0])
    if variant == "orthonormal":
        tangent = _scaled_to_one(tangent)
        bitangent = _cross(normal, tangent)
    else:
        bitangent = derivative(inverse[:, 1])
        if variant == "normalized":
            tangent, bitangent = _scaled_to_one(tangent), _scaled_to_one(bitangent)
    return _as_columns(tangent, bitangent, normal)


def edge_rotations(
    vertices: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "*batch F 3 3"]:
    """Proper rotations with columns along each triangle's first edge, across it, outward normal.

    `tangent_frames`' orthonormal ones of a mesh without a UV map, in a third of the time.
    """
    first, second = _wide_edges(vertices, faces)
    normal, along = _scaled_to_one(_cross(first, second)), _scaled_to_one(first)
    return _as_columns(along, _cross(normal, along), normal)


def _as_columns(*columns: _Planes) -> Float[Tensor, "*batch F 3 3"]:
    rows = [entry for row in zip(*columns) for entry in row]
    return torch.stack(rows).movedim(0, -1).contiguous().unflatten(-1, (3, 3))


def _wide_edges(
    vertices: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[_Planes, _Planes]:
    """Two edges of each triangle; the world's x and y for triangles without area.

    x, y, z lie in planes of their own: several times faster than rows of three.
    """
    first, second = _edges(vertices, faces)
    keep = _has_area(first, second)
    first = (first[0] * keep + (1 - keep), first[1] * keep, first[2] * keep)
    return first, (second[0] * keep, second[1] * keep + (1 - keep), second[2] * keep)


def _edges(
    vertices: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[_Planes, _Planes]:
    """From each triangle's first corner to its second and third, as planes [*batch, F]."""
    planes = vertices.movedim(-1, 0).contiguous()
    corners = [
        planes.gather(-1, faces[:, corner].expand(*planes.shape[:-1], -1)) for corner in range(3)
    ]
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    return tuple(first.unbind(0)), tuple(second.unbind(0))


def _dot(a: _Planes, b: _Planes) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: _Planes, b: _Planes) -> _Planes:
    (ax, ay, az), (bx, by, bz) = a, b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def _scaled_to_one(a: _Planes) -> _Planes:
    factor = torch.rsqrt(_dot(a, a))
    return tuple(entry * factor for entry in a)


@torch.no_grad()
def _has_area(first: _Planes, second: _Planes) -> Float[Tensor, "*batch F"]:
    """0 where two edges are (nearly) parallel or have no length, else 1."""
    cross = _cross(first, second)
    wide = _dot(cross, cross) > 1e-10 * _dot(first, first) * _dot(second, second) + 1e-30
    return wide.to(cross[0])


def edges_to_frame(
    uv: Float[Tensor, "VT 2"], uv_faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "F 2 2"]:
    """Each triangle's matrix whose rows give T and B from its two edges, in float64.

    The identity where there is no area.
    """
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

    T and B of `normalized` and `raw` frames are not orthogonal, but a Gaussian needs a rotation:
    the normal stays, and within the surface's plane the axes are taken that are nearest to T and B
    in the least-squares sense, weighted by their length. An orthonormal frame is its own. Where the
    UV map is mirrored, B is negated first. Ours; the paper (sec. 3.1) does not say how q_D = R q_T
    is meant where R is no rotation.
    """
    entries = frames.flatten(-2).movedim(-1, 0).contiguous().unbind(0)
    tangent, bitangent, normal = entries[0::3], entries[1::3], entries[2::3]
    # In the plane: turning B back by 90 degrees (B x N) gives a second wish for T's direction.
    turned = _cross(bitangent, normal)
    sign = 1 - 2 * (_dot(turned, tangent) < 0).to(frames)
    wished = tuple(t + sign * q for t, q in zip(tangent, turned))
    off_plane = _dot(wished, normal)
    along_u = _scaled_to_one(tuple(w - off_plane * n for w, n in zip(wished, normal)))
    along_v = _cross(normal, along_u)
    rows = [entry for row in zip(along_u, along_v, normal) for entry in row]
    return matrix_to_quat_wxyz(torch.stack(rows).movedim(0, -1).unflatten(-1, (3, 3)))
