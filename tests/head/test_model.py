import dataclasses

import numpy as np
import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, HeadModel
from tests.head.synthetic_head import flame_shaped_arrays


@pytest.fixture(scope="module")
def synthetic() -> HeadModel:
    return HeadModel(flame_shaped_arrays(), torch.float64)


@pytest.fixture(scope="module")
def embedded() -> HeadModel:
    return HeadModel.embedded(torch.float64)


@pytest.fixture(params=["synthetic", "embedded"])
def head(request: pytest.FixtureRequest) -> HeadModel:
    return request.getfixturevalue(request.param)


def random_theta(head: HeadModel, *batch: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    theta = torch.randn(*batch, head.layout.size, generator=generator, dtype=torch.float64)
    return theta * 0.3


def random_identity(head: HeadModel, *batch: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(9)
    return torch.randn(*batch, head.num_identity, generator=generator, dtype=torch.float64)


def rodrigues(axis_angle: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(axis_angle)
    if angle == 0:
        return np.eye(3)
    x, y, z = axis_angle / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def flame_by_hand(arrays: HeadArrays, parts: dict[str, np.ndarray], identity: np.ndarray):
    """Equations 1 to 5 of the FLAME paper with 4 x 4 matrices, one head, plain loops."""
    coefficients = np.concatenate([identity, parts["expression"]])
    shaped = arrays.v_template.astype(np.float64) + arrays.shapedirs @ coefficients
    joints = arrays.joint_regressor @ shaped
    fields = ("rotation", "neck", "jaw", "left_eye", "right_eye")
    turns = [rodrigues(parts[name]) for name in fields]
    pose_feature = np.concatenate([(turn - np.eye(3)).ravel() for turn in turns[1:]])
    shaped = shaped + arrays.posedirs @ pose_feature
    if arrays.eyelid_dirs is not None:
        shaped = shaped + arrays.eyelid_dirs @ parts["eyelids"]
    world = []
    for joint, parent in enumerate(arrays.parents):
        local = np.eye(4)
        local[:3, :3] = turns[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        world.append(local if parent < 0 else world[parent] @ local)
    vertices = np.zeros_like(shaped)
    for joint in range(5):
        from_rest = world[joint].copy()
        from_rest[:3, 3] -= world[joint][:3, :3] @ joints[joint]
        moved = shaped @ from_rest[:3, :3].T + from_rest[:3, 3]
        vertices += arrays.skinning_weights[:, joint, None] * moved
    return vertices + parts["translation"]


def test_zero_theta_gives_the_template_to_the_bit(head: HeadModel) -> None:
    template = torch.tensor(head.arrays.v_template, dtype=torch.float64)
    theta = torch.zeros(2, head.layout.size, dtype=torch.float64)
    assert torch.equal(head(theta)[1], template)
    assert torch.equal(
        head(theta, torch.zeros(head.num_identity, dtype=torch.float64))[0], template
    )


def test_agrees_with_the_equations_by_hand(head: HeadModel) -> None:
    theta, identity = random_theta(head, 2), random_identity(head)
    vertices = head(theta, identity)
    for row in range(2):
        parts = {name: part[row].numpy() for name, part in head.layout.split(theta).items()}
        wanted = flame_by_hand(head.arrays, parts, identity.numpy())
        np.testing.assert_allclose(vertices[row], wanted, atol=1e-7)


@pytest.mark.parametrize("batch", [(), (3,), (2, 2), (0,)])
def test_batch_equals_loop(synthetic: HeadModel, batch: tuple[int, ...]) -> None:
    theta, identity = random_theta(synthetic, *batch), random_identity(synthetic, *batch)
    together = synthetic(theta, identity)
    assert together.shape == (*batch, 36, 3)
    for index in np.ndindex(*batch):
        torch.testing.assert_close(together[index], synthetic(theta[index], identity[index]))


def test_some_vertices_are_those_of_all(head: HeadModel) -> None:
    theta, identity = random_theta(head, 3), random_identity(head)
    only = torch.tensor([7, 0, 7, len(head.arrays.v_template) - 1])
    some, every = head(theta, identity, only), head(theta, identity)
    torch.testing.assert_close(some, every[:, only])


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_gradients_agree_with_differences_in_every_parameter(
    synthetic: HeadModel, scale: float
) -> None:
    theta = (scale * random_theta(synthetic)).requires_grad_()
    identity = random_identity(synthetic).requires_grad_()
    probe = torch.randn(36, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    (synthetic(theta, identity) * probe).sum().backward()
    assert theta.grad is not None
    assert identity.grad is not None
    with torch.no_grad():
        for values, gradient, at in (
            (theta, theta.grad, lambda moved: synthetic(moved, identity.expand(len(moved), -1))),
            (identity, identity.grad, lambda moved: synthetic(theta.expand(len(moved), -1), moved)),
        ):
            steps = 1e-5 * torch.eye(len(values), dtype=torch.float64)
            change = at(values + steps) - at(values - steps)
            differences = (change * probe).sum((1, 2)) / 2e-5
            torch.testing.assert_close(gradient, differences, atol=1e-8, rtol=1e-7)


def test_float32_stays_near_float64() -> None:
    single, double = HeadModel.embedded(), HeadModel.embedded(torch.float64)
    theta = random_theta(double, 3)
    error = single(theta.float()).double() - double(theta)
    assert single(theta.float()).dtype == torch.float32
    assert error.abs().max() < 2e-6


def test_wrong_sizes_are_refused(synthetic: HeadModel) -> None:
    with pytest.raises(UserError, match="theta has 7"):
        synthetic(torch.zeros(1, 7, dtype=torch.float64))
    with pytest.raises(UserError, match="identity has 5"):
        synthetic(random_theta(synthetic, 1), torch.zeros(5, dtype=torch.float64))


def test_users_of_the_tensors_cannot_change_the_shared_arrays() -> None:
    head = HeadModel.embedded()
    head.uv.add_(1)
    head.faces.add_(1)
    again = HeadArrays.embedded()
    assert again.uv.max() <= 1
    assert again.faces.min() == 0
    assert not list(head.state_dict())


def test_a_remembered_identity_is_not_mistaken_for_another(synthetic: HeadModel) -> None:
    theta, identity = random_theta(synthetic), random_identity(synthetic)
    fresh = HeadModel(synthetic.arrays, torch.float64)
    first = synthetic(theta, identity)
    assert torch.equal(synthetic(theta, identity), first)
    assert torch.equal(synthetic(theta, identity.clone()), first)
    identity[0] += 1  # In place: the same tensor, another person.
    second = synthetic(theta, identity)
    torch.testing.assert_close(second, fresh(theta, identity), atol=0, rtol=0)
    assert not torch.equal(first, second)
    assert not torch.equal(synthetic.joints(identity), synthetic.joints())
    # The head in another type, and gradients after a call without them.
    moved = HeadModel(synthetic.arrays, torch.float64)
    moved(theta, identity)
    assert moved.float()(theta.float(), identity.float()).dtype == torch.float32
    with torch.inference_mode():
        synthetic(theta, identity)
    theta.requires_grad_()
    synthetic(theta, identity).sum().backward()
    assert theta.grad is not None


def test_blended_joint_transforms_carry_the_shaped_head_to_where_it_is(head: HeadModel) -> None:
    theta, identity = random_theta(head, 2, 2), random_identity(head)
    still = theta.clone()
    for name in ("rotation", "neck", "jaw", "left_eye", "right_eye", "translation"):
        still[..., head.layout.slice(name)] = 0
    shaped = head(still, identity)
    turned = theta.clone()
    if head.arrays.posedirs.any():
        # Correctives are shaped on, too, before the joints move anything: here they are left out.
        arrays = dataclasses.replace(head.arrays, posedirs=np.zeros_like(head.arrays.posedirs))
        head = HeadModel(arrays, torch.float64)
    transforms = head.joint_transforms(turned, identity)
    assert transforms.shape == (2, 2, 5, 4, 4)
    weights = torch.tensor(head.arrays.skinning_weights, dtype=torch.float64)
    blended = torch.einsum("vj,bcjxy->bcvxy", weights, transforms)
    carried = (blended[..., :3, :3] @ shaped[..., None])[..., 0] + blended[..., :3, 3]
    torch.testing.assert_close(carried, head(turned, identity), atol=1e-7, rtol=0)
    assert torch.equal(blended[..., 3, :3], torch.zeros(2, 2, len(weights), 3).double())


def test_joints_of_a_head_at_rest_move_nothing(head: HeadModel) -> None:
    theta = torch.zeros(3, head.layout.size, dtype=torch.float64)
    transforms = head.joint_transforms(theta, random_identity(head))
    assert torch.equal(transforms, torch.eye(4, dtype=torch.float64).expand(3, 5, 4, 4))
