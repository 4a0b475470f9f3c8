"""Every conversion of rotations in the project; roma inside, whose quaternions are xyzw.

Matrices act on columns, quaternions are real part first (wxyz), axis-angle is in radians.
"""

import roma
import torch
from jaxtyping import Float
from torch import Tensor


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of axis-angle vectors; zero gives the identity, with a finite gradient."""
    return roma.rotvec_to_rotmat(axis_angle)


def matrix_to_axis_angle(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vectors, of length at most pi, of proper rotations."""
    return roma.rotmat_to_rotvec(matrix)


def matrix_to_6d_rows(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """The first two ROWS of the matrix, one after the other; the identity is 1 0 0 0 1 0.

    Source: the release's and metrical-tracker's 6D form (Zhou et al. 2019 take columns).
    """
    return matrix[..., :2, :].flatten(-2)


def rows_6d_to_matrix(rows: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Proper rotation whose first rows are these six numbers after Gram-Schmidt."""
    columns = rows.unflatten(-1, (2, 3)).transpose(-1, -2)
    return roma.special_gramschmidt(columns).transpose(-1, -2)


def matrix_to_quat_wxyz(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of proper rotations; the sign is either."""
    return roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(matrix))


def quat_wxyz_to_matrix(quat_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions of any length but zero."""
    return roma.unitquat_to_rotmat(
        torch.nn.functional.normalize(roma.quat_wxyz_to_xyzw(quat_wxyz), dim=-1)
    )


def quat_multiply_wxyz(
    first: Float[Tensor, "*batch 4"], second: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Hamilton product: the rotation by `second`, then by `first`. Broadcasts."""
    product = roma.quat_product(roma.quat_wxyz_to_xyzw(first), roma.quat_wxyz_to_xyzw(second))
    return roma.quat_xyzw_to_wxyz(product)
