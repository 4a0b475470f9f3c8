"""Every conversion of rotations in the project; roma inside, whose quaternions are xyzw.

roma is imported where it is used: it brings torch's compiler, which takes as long as torch.
Matrices act on columns, quaternions are real part first (wxyz), axis-angle is in radians.
"""

import functools
import math
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor


@functools.cache
def _cross_product(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 9"]:
    """What each component of v adds to the matrix of v x, row by row.

    Copied to a device once: a copy in each call would keep a step out of a CUDA graph.
    """
    x = (0, 0, 0, 0, 0, -1, 0, 1, 0)
    y = (0, 0, 1, 0, 0, 0, -1, 0, 0)
    z = (0, -1, 0, 1, 0, 0, 0, 0, 0)
    with torch.inference_mode(False):
        return torch.tensor([x, y, z], dtype=dtype, device=device)


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of axis-angle vectors; zero gives the identity, with a finite gradient.

    Rodrigues' formula, R = cos(a) I + sin(a)/a [v]x + (1 - cos(a))/a^2 v v^T, written out: a head
    has five of them, and roma's many small operations took longer than its skinning. The tests
    compare the two.
    """
    angle = torch.linalg.vector_norm(axis_angle, dim=-1, keepdim=True)[..., None]
    # torch.sinc(x) is sin(pi x) / (pi x); 1 - cos(a) = 2 sin(a / 2)^2 without cancellation.
    along_cross = torch.sinc(angle / math.pi)
    along_outer = 0.5 * torch.sinc(angle / (2 * math.pi)).square()
    cross = axis_angle @ _cross_product(axis_angle.dtype, axis_angle.device)
    outer = axis_angle[..., :, None] * axis_angle[..., None, :]
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    about_axis = torch.addcmul(identity * torch.cos(angle), along_outer, outer)
    return torch.addcmul(about_axis, along_cross, cross.unflatten(-1, (3, 3)))


def matrix_to_axis_angle(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vectors, of length at most pi, of proper rotations."""
    import roma

    return roma.rotmat_to_rotvec(matrix)


def axis_angle_between(
    first: Float[Tensor, "*batch 3"], second: Float[Tensor, "*batch 3"], share: float
) -> Float[Tensor, "*batch 3"]:
    """The rotation after a share in [0, 1] of the shortest turn from the first to the second."""
    start = axis_angle_to_matrix(first)
    turn = matrix_to_axis_angle(start.transpose(-1, -2) @ axis_angle_to_matrix(second))
    return matrix_to_axis_angle(start @ axis_angle_to_matrix(share * turn))


def matrix_to_view_degrees(
    head_to_camera: Float[Tensor, "*batch 3 3"],
) -> Float[Tensor, "*batch 3"]:
    """How a camera (OpenCV's axes) sees a head: yaw, pitch and roll in degrees, 0 from the front.

    Positive yaw shows the head's left side, positive pitch looks from below, positive roll sees it
    tilted to its right shoulder: the matrix is that of the frontal view after turns by -yaw about
    y, -pitch about x and roll about z, in this order.
    """
    to_left, to_top, to_front = head_to_camera[..., 2, :].neg().unbind(-1)
    yaw = torch.atan2(to_left, to_front)
    pitch = torch.atan2(-to_top, torch.hypot(to_left, to_front))
    x, y = head_to_camera[..., :2, 0].unbind(-1), head_to_camera[..., :2, 2].unbind(-1)
    level_x, level_y = (a * yaw.cos() - b * yaw.sin() for a, b in zip(x, y))
    return torch.stack([yaw, pitch, torch.atan2(-level_y, level_x)], -1).rad2deg()


def matrix_to_6d_rows(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """The first two ROWS of the matrix, one after the other; the identity is 1 0 0 0 1 0.

    Source: the release's and metrical-tracker's 6D form (Zhou et al. 2019 take columns).
    """
    return matrix[..., :2, :].flatten(-2)


def rows_6d_to_matrix(rows: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Proper rotation whose first rows are these six numbers after Gram-Schmidt."""
    import roma

    columns = rows.unflatten(-1, (2, 3)).transpose(-1, -2)
    return roma.special_gramschmidt(columns).transpose(-1, -2)


def quat_wxyz_to_matrix(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions of any length but zero."""
    import roma

    unit = torch.nn.functional.normalize(quat_wxyz, dim=-1)
    return roma.unitquat_to_rotmat(unit.roll(-1, -1))


def matrix_to_quat_wxyz(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of proper rotations; the sign is either.

    Written out (Day 2015, "Converting a rotation matrix to a quaternion"), because roma's own
    takes ten times as long on a head's triangles; the tests compare the two.
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
    # Which component is surely not small, as factors 0 and 1: cheaper than torch.where here.
    z_down, x_wins, z_wins = ((m22 < 0).to(matrix), (m00 > m11).to(matrix), (m00 < -m11).to(matrix))
    is_x, is_y = z_down * x_wins, z_down * (1 - x_wins)
    is_z, is_w = (1 - z_down) * z_wins, (1 - z_down) * (1 - z_wins)
    sign_x, sign_y, sign_z = is_w + is_x - is_y - is_z, is_w + is_y - is_x - is_z, 1 - 2 * z_down
    # Four times the square of that component.
    square = 1 + sign_x * m00 + sign_y * m11 + sign_z * m22
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m01 + m10, m02 + m20, m12 + m21

    def pick(w: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return is_w * w + is_x * x + is_y * y + is_z * z

    factor = 0.5 * torch.rsqrt(square)
    quat = [
        pick(square, wx, wy, wz) * factor,
        pick(wx, square, xy, xz) * factor,
        pick(wy, xy, square, yz) * factor,
        pick(wz, xz, yz, square) * factor,
    ]
    return torch.stack(quat).movedim(0, -1).contiguous()


def multiply_quats_wxyz(
    first: Float[Tensor, "*#batch 4"], second: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """The Hamilton product of quaternions of any length: first the second turn, then the first."""
    return _QuatProduct.apply(*torch.broadcast_tensors(first, second))


def conjugate_quats_wxyz(quats_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The turns back, of the same length."""
    return torch.cat([quats_wxyz[..., :1], -quats_wxyz[..., 1:]], -1)


def turn_back(
    quats_wxyz: Float[Tensor, "*batch 4"], vectors: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Vectors as seen from axes that are turned by unit quaternions."""
    pure = torch.nn.functional.pad(vectors, (1, 0))
    turned = multiply_quats_wxyz(conjugate_quats_wxyz(quats_wxyz), pure)
    return multiply_quats_wxyz(turned, quats_wxyz)[..., 1:]


class _QuatProduct(torch.autograd.Function):
    """`multiply_quats_wxyz` of equal shapes, with its gradient written out.

    A quaternion is a pair of complex numbers, q = (w + x i) + (y + z i) j, with j c = conj(c) j:
    on a CPU a quarter of the time of the sixteen products through autograd.
    """

    @staticmethod
    def forward(
        ctx: Any, first: Float[Tensor, "*batch 4"], second: Float[Tensor, "*batch 4"]
    ) -> Float[Tensor, "*batch 4"]:
        ctx.save_for_backward(first, second)
        return _product(_to_complex(first), _to_complex(second))

    @staticmethod
    def backward(
        ctx: Any, *grad_outputs: Float[Tensor, "*batch 4"]
    ) -> tuple[Float[Tensor, "*batch 4"] | None, Float[Tensor, "*batch 4"] | None]:
        first, second = (_to_complex(quats) for quats in ctx.saved_tensors)
        outer = _to_complex(grad_outputs[0])
        need_first, need_second = ctx.needs_input_grad
        return (
            _product(outer, _conjugate(second)) if need_first else None,
            _product(_conjugate(first), outer) if need_second else None,
        )


def _to_complex(quats_wxyz: Float[Tensor, "*batch 4"]) -> Complex[Tensor, "*batch 2"]:
    return torch.view_as_complex(quats_wxyz.contiguous().unflatten(-1, (2, 2)))


def _conjugate(quats: Complex[Tensor, "*batch 2"]) -> Complex[Tensor, "*batch 2"]:
    """conj(a + b j) = conj(a) - b j."""
    return torch.stack((quats[..., 0].conj(), -quats[..., 1]), dim=-1)


def _product(
    first: Complex[Tensor, "*batch 2"], second: Complex[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch 4"]:
    """(a + b j)(c + d j) = (a c - b conj(d)) + (a d + b conj(c)) j."""
    (a, b), (c, d) = first.unbind(-1), second.unbind(-1)
    product = torch.empty_like(second)
    torch.mul(a, c, out=product[..., 0]).addcmul_(b, d.conj(), value=-1)
    torch.mul(a, d, out=product[..., 1]).addcmul_(b, c.conj())
    return torch.view_as_real(product).flatten(-2)
