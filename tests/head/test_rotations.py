import math

import numpy as np
import roma
import torch
from scipy.spatial.transform import Rotation

from rgbavatar_ns.head import rotations

ANGLES = torch.tensor(
    np.concatenate(
        [
            np.random.default_rng(0).normal(size=(200, 3)),
            math.pi * np.eye(3),
            -0.999 * math.pi * np.eye(3),
            np.zeros((1, 3)),
        ]
    )
)


def test_conversions_agree_with_scipy() -> None:
    known = Rotation.from_rotvec(ANGLES.numpy())
    matrix = rotations.axis_angle_to_matrix(ANGLES)
    np.testing.assert_allclose(matrix, known.as_matrix(), atol=1e-12)
    quat_wxyz = rotations.matrix_to_quat_wxyz(matrix).numpy()
    xyzw = known.as_quat()
    wanted = np.concatenate([xyzw[:, 3:], xyzw[:, :3]], 1)
    same_sign = np.sign((quat_wxyz * wanted).sum(1, keepdims=True))
    np.testing.assert_allclose(quat_wxyz, wanted * same_sign, atol=1e-12)
    back = rotations.axis_angle_to_matrix(rotations.matrix_to_axis_angle(matrix))
    np.testing.assert_allclose(back, matrix, atol=1e-9)


def test_between_two_rotations_turns_evenly_the_short_way() -> None:
    first, second = ANGLES[:100], ANGLES[100:200]
    known = [Rotation.from_rotvec(part.numpy()) for part in (first, second)]
    turn = (known[0].inv() * known[1]).as_rotvec()
    for share in (0.0, 0.3, 1.0):
        between = rotations.axis_angle_between(first, second, share)
        wanted = known[0] * Rotation.from_rotvec(share * turn)
        matrix = rotations.axis_angle_to_matrix(between)
        np.testing.assert_allclose(matrix, wanted.as_matrix(), atol=1e-9)


def test_six_numbers_are_the_first_two_rows() -> None:
    matrix = rotations.axis_angle_to_matrix(ANGLES)
    rows = rotations.matrix_to_6d_rows(matrix)
    assert torch.equal(rows[:, :3], matrix[:, 0])
    assert torch.equal(rows[:, 3:], matrix[:, 1])
    assert rotations.matrix_to_6d_rows(torch.eye(3)).tolist() == [1, 0, 0, 0, 1, 0]
    torch.testing.assert_close(rotations.rows_6d_to_matrix(rows), matrix)


def test_no_rotation_is_exactly_the_identity_with_the_right_gradient() -> None:
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    matrix = rotations.axis_angle_to_matrix(zero)
    assert torch.equal(matrix, torch.eye(3, dtype=torch.float64))
    matrix[2, 1].backward()
    assert zero.grad is not None
    assert zero.grad.tolist() == [1, 0, 0]


def test_quaternion_gradients_agree_with_differences() -> None:
    angles = ANGLES[:6].clone().requires_grad_()

    def quat(axis_angle: torch.Tensor) -> torch.Tensor:
        return rotations.matrix_to_quat_wxyz(rotations.axis_angle_to_matrix(axis_angle))

    assert torch.autograd.gradcheck(quat, (angles,))


def test_axis_angle_agrees_with_roma_at_small_and_large_angles() -> None:
    """Also in float32, and its gradient, where the angle is zero or nearly so."""
    for factor in (1.0, 1e-2, 1e-4, 1e-8):
        angles = (factor * ANGLES).requires_grad_()
        expected = roma.rotvec_to_rotmat(angles)
        np.testing.assert_allclose(
            rotations.axis_angle_to_matrix(angles).detach(), expected.detach(), atol=1e-13
        )
        single = rotations.axis_angle_to_matrix(angles.detach().float())
        np.testing.assert_allclose(single, expected.detach(), atol=1e-6)
        probe = torch.randn(expected.shape, generator=torch.Generator().manual_seed(1)).double()
        gradients = [
            torch.autograd.grad((matrix * probe).sum(), angles)[0]
            for matrix in (expected, rotations.axis_angle_to_matrix(angles))
        ]
        np.testing.assert_allclose(gradients[1], gradients[0], atol=1e-7)
    assert torch.equal(
        rotations.axis_angle_to_matrix(torch.zeros(2, 3)), torch.eye(3).expand(2, 3, 3)
    )


def test_a_quaternion_of_any_length_is_the_matrix_that_it_came_from() -> None:
    turns = rotations.axis_angle_to_matrix(torch.randn(20, 3, dtype=torch.float64))
    quats_wxyz = rotations.matrix_to_quat_wxyz(turns)
    assert torch.allclose(rotations.quat_wxyz_to_matrix(3 * quats_wxyz), turns, atol=1e-12)


def test_a_product_of_quaternions_turns_by_the_second_then_the_first() -> None:
    generator = torch.Generator().manual_seed(5)
    first = torch.randn(2, 7, 4, generator=generator, dtype=torch.float64)
    second = torch.randn(1, 7, 4, generator=generator, dtype=torch.float64)
    product = rotations.multiply_quats_wxyz(first, second)
    wanted = rotations.quat_wxyz_to_matrix(first) @ rotations.quat_wxyz_to_matrix(second)
    torch.testing.assert_close(rotations.quat_wxyz_to_matrix(product), wanted)
    torch.testing.assert_close(product.norm(dim=-1), first.norm(dim=-1) * second.norm(dim=-1))
    back = rotations.multiply_quats_wxyz(product, rotations.conjugate_quats_wxyz(second))
    torch.testing.assert_close(back, first * second.square().sum(-1, keepdim=True))
    inputs = (first.requires_grad_(), second.requires_grad_())
    assert torch.autograd.gradcheck(rotations.multiply_quats_wxyz, inputs)


def test_turning_back_undoes_the_matrix() -> None:
    random = torch.Generator().manual_seed(5)
    quats = torch.nn.functional.normalize(torch.randn(20, 4, generator=random).double(), dim=-1)
    vectors = torch.randn(20, 3, generator=random).double()
    turned = (rotations.quat_wxyz_to_matrix(quats) @ vectors[..., None])[..., 0]
    torch.testing.assert_close(rotations.turn_back(quats, turned), vectors)
