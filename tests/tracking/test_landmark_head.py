from dataclasses import replace

import numpy as np
import pytest
import torch

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.landmark_head import LandmarkHead


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.embedded(dtype=torch.float64)


def _landmarks(head: HeadModel, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(5)
    faces = head.arrays.faces
    triangles = random.integers(0, len(faces), count)
    return faces[triangles].astype(np.int64), random.dirichlet(np.ones(3), count)


def _theta(head: HeadModel, seed: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    theta = random.uniform(-0.4, 0.4, head.layout.size)
    expression = head.layout.slice("expression")
    theta[expression] = random.uniform(0, 1, expression.stop - expression.start)
    return theta, random.normal(size=head.num_identity)


@pytest.mark.parametrize("seed", range(4))
def test_reduced_head_equals_the_full_head_at_its_landmarks(head: HeadModel, seed: int) -> None:
    vertex_ids, barycentric = _landmarks(head)
    theta, identity = _theta(head, seed)
    vertices = head(torch.from_numpy(theta), torch.from_numpy(identity)).numpy()
    expected = (vertices[vertex_ids] * barycentric[..., None]).sum(1)
    reduced = LandmarkHead(head, vertex_ids, barycentric)
    np.testing.assert_allclose(reduced.points(theta, identity), expected, atol=1e-9)
    person = reduced.of_person(identity)
    np.testing.assert_allclose(person.points(theta, np.zeros(0)), expected, atol=1e-9)


def _with_pose_correctives(head: HeadModel) -> HeadModel:
    """The same head with correctives as FLAME has them."""
    random = np.random.default_rng(8)
    pose_dirs = 0.01 * random.normal(size=head.arrays.posedirs.shape)
    arrays = replace(head.arrays, posedirs=pose_dirs.astype(np.float16))
    return HeadModel(arrays, dtype=torch.float64)


@pytest.mark.parametrize("correctives", [False, True])
@pytest.mark.parametrize("still", [False, True])
def test_derivatives_equal_those_of_the_full_head_by_automatic_differentiation(
    head: HeadModel, correctives: bool, still: bool
) -> None:
    head = _with_pose_correctives(head) if correctives else head
    vertex_ids, barycentric = _landmarks(head, 20)
    theta, identity = _theta(head, 9)
    if still:
        theta[:] = 0

    def points(theta: torch.Tensor, identity: torch.Tensor) -> torch.Tensor:
        corners = head(theta, identity)[torch.from_numpy(vertex_ids)]
        return (corners * torch.from_numpy(barycentric)[..., None]).sum(1)

    expected = torch.autograd.functional.jacobian(
        points, (torch.from_numpy(theta), torch.from_numpy(identity)), vectorize=True
    )
    reduced = LandmarkHead(head, vertex_ids, barycentric)
    columns = np.random.default_rng(2).permutation(head.layout.size)
    found = reduced.jacobian(theta, identity, reduced.unknowns(columns, 7))
    derivative = found.derivative.transpose(1, 0, 2)
    np.testing.assert_allclose(found.points, reduced.points(theta, identity), atol=1e-14)
    np.testing.assert_allclose(
        derivative[..., : len(columns)], expected[0].numpy()[..., columns], atol=1e-9
    )
    np.testing.assert_allclose(
        derivative[..., len(columns) :], expected[1].numpy()[..., :7], atol=1e-9
    )


def test_offsets_ride_with_the_head(head: HeadModel) -> None:
    vertex_ids, barycentric = _landmarks(head, 10)
    offsets = np.random.default_rng(1).normal(size=(10, 3)) * 0.01
    reduced = LandmarkHead(head, vertex_ids, barycentric)
    theta, identity = _theta(head, 3)
    theta[: head.layout.slice("rotation").start] = 0
    for name in ("neck", "jaw", "left_eye", "right_eye"):
        theta[head.layout.slice(name)] = 0
    moved = reduced.with_offsets(offsets).points(theta, identity)
    turned = offsets @ reduced.head_rotation(theta).T
    np.testing.assert_allclose(moved - reduced.points(theta, identity), turned, atol=1e-12)
