from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.landmarks import LandmarkResponse, facemesh_landmarks, facemesh_response
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead


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


@pytest.mark.parametrize("correctives", [False, True])
@pytest.mark.parametrize("still", [False, True])
def test_derivatives_equal_those_of_the_full_head_by_automatic_differentiation(
    head: HeadModel, correctives: bool, still: bool
) -> None:
    if correctives:  # as FLAME has them
        directions = 0.01 * np.random.default_rng(8).normal(size=head.arrays.posedirs.shape)
        arrays = replace(head.arrays, posedirs=directions.astype(np.float16))
        head = HeadModel(arrays, dtype=torch.float64)
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
    posed = reduced.posed(theta, identity)
    derivative = reduced.derivative(posed, reduced.unknowns(columns, 7))
    by_torch = torch.cat([expected[0][..., columns], expected[1][..., :7]], -1)
    np.testing.assert_allclose(derivative, by_torch, atol=1e-9)


def _with_identities(head: HeadModel, motion_m: np.ndarray) -> LandmarkHead:
    """Landmarks of this head, whose identity moves all of it by these [C, 3] metres."""
    arrays = head.arrays
    still = arrays.shapedirs[..., arrays.num_identity :]
    moved = np.broadcast_to(motion_m.T, (len(still), *motion_m.T.shape)).astype(np.float32)
    shapedirs = np.concatenate([moved, still], axis=2)
    other = replace(arrays, shapedirs=shapedirs, num_identity=len(motion_m))
    return LandmarkHead(HeadModel(other, dtype=torch.float64), *_landmarks(head))


def test_depth_has_all_of_what_moves_ahead_and_none_of_what_moves_across(head: HeadModel) -> None:
    # 3 cm ahead, 2 cm up, and what moves nothing; then 3 mm aside with 4 ahead.
    apart = _with_identities(head, np.array([[0, 0, 0.03], [0, 0.02, 0], [0, 0, 0]]))
    np.testing.assert_allclose(apart.depth_share(3), np.diag([1.0, 0, 0]), atol=1e-6)
    slanting = _with_identities(head, np.array([[0.003, 0, 0.004]]))
    np.testing.assert_allclose(slanting.depth_share(1), [[16 / 25]], rtol=1e-5)
    # Ahead, and ahead and aside as far: G = [1 1; 1 2], its root [2 1; 1 3] / sqrt(5).
    mixed = _with_identities(head, np.array([[0, 0, 0.01], [0.01, 0, 0.01]]))
    np.testing.assert_allclose(mixed.depth_share(2), np.array([[4, 2], [2, 1]]) / 5, atol=1e-4)
    assert apart.depth_share(0).shape == (0, 0)


def test_depths_share_is_that_of_the_full_heads_motions(head: HeadModel) -> None:
    vertex_ids, barycentric = _landmarks(head)
    count = head.num_identity
    rest = torch.zeros(head.layout.size, dtype=torch.float64)
    persons = torch.cat([torch.zeros(1, count), torch.eye(count)]).double()
    corners = torch.stack([head(rest, person) for person in persons])[:, vertex_ids]
    points = (corners * torch.from_numpy(barycentric)[..., None]).sum(2).numpy()
    moved = points[1:] - points[0]
    root = sqrtm(np.einsum("clx,dlx->cd", moved, moved)).real
    expected = np.linalg.solve(root, np.linalg.solve(root, moved[..., 2] @ moved[..., 2].T).T)
    share = LandmarkHead(head, vertex_ids, barycentric).depth_share(count)
    np.testing.assert_allclose(share, expected, atol=1e-6)
    sizes = np.linalg.eigvalsh(share)
    assert sizes.min() > -1e-9
    assert sizes.max() < 1 + 1e-9


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


def _response(head: HeadModel, count: int) -> LandmarkResponse:
    random = np.random.default_rng(11)
    sizes = ((), (5,), (head.arrays.num_expressions,), (), (2,), (head.num_identity,))
    return LandmarkResponse(*(0.005 * random.normal(size=(count, 3, *size)) for size in sizes))


def test_a_response_adds_its_terms_in_the_turned_frame(head: HeadModel) -> None:
    vertex_ids, barycentric = _landmarks(head, 10)
    bare, response = LandmarkHead(head, vertex_ids, barycentric), _response(head, 10)
    theta, identity = _theta(head, 4)
    eye = np.array([0.1, -0.2, 0.9])
    added = bare.with_response(response).points(theta, identity, eye) - bare.points(theta, identity)
    skull = bare.head_rotation(theta)
    # Expressions move the joints too; the second is where the neck carries the skull.
    at_rest = bare._joint_rest + bare._joint_dirs @ bare._coefficients(theta, identity)
    rotation, shift = (theta[head.layout.slice(name)] for name in ("rotation", "translation"))
    root = axis_angle_to_matrix(torch.from_numpy(rotation)).numpy()
    towards = eye - (root @ (at_rest[1] - at_rest[0]) + at_rest[0] + shift)
    x, y, _ = skull.T @ (towards / np.linalg.norm(towards))
    eyes = [theta[head.layout.slice(name)][:2] for name in ("left_eye", "right_eye")]
    by_hand = (
        response.rest
        + response.view @ [x, y, x * x, y * y, x * y]
        + response.expression @ theta[head.layout.slice("expression")]
        + response.jaw_open * np.sin(theta[head.layout.slice("jaw").start])
        + response.gaze @ (np.sin(eyes[0]) + np.sin(eyes[1])) / 2
        + response.identity @ identity
    )
    moved = bare.with_offsets(by_hand).points(theta, identity)
    np.testing.assert_allclose(added, moved - bare.points(theta, identity), atol=1e-12)


@pytest.mark.parametrize("still", [False, True])
def test_derivatives_with_a_response_equal_finite_differences(head: HeadModel, still: bool) -> None:
    vertex_ids, barycentric = _landmarks(head, 12)
    seen = LandmarkHead(head, vertex_ids, barycentric).with_response(_response(head, 12))
    theta, identity = _theta(head, 6)
    if still:
        theta[:] = 0
    columns, step = np.arange(head.layout.size), 1e-6
    found = seen.derivative(seen.posed(theta, identity), seen.unknowns(columns, 3))
    both = np.concatenate([theta, identity])
    for place in range(len(theta) + 3):
        away = step * (np.arange(len(both)) == place)
        low, high = (
            seen.points(*np.split(end, [len(theta)])) for end in (both - away, both + away)
        )
        np.testing.assert_allclose(found[..., place], (high - low) / (2 * step), atol=1e-8)
    # A person's head has it folded in.
    of_person = seen.of_person(identity).points(theta, np.zeros(0))
    np.testing.assert_allclose(of_person, seen.points(theta, identity), atol=1e-12)


def test_facemeshs_response_is_one_for_each_landmark_and_moderate(head: HeadModel) -> None:
    response, marks = facemesh_response(), facemesh_landmarks()
    assert response.rest.shape == (len(marks.triangle), 3)
    assert response.expression.shape[-1] == head.arrays.num_expressions
    assert response.identity.shape[-1] == head.num_identity
    assert all(np.isfinite(part).all() for part in vars(response).values())
    assert np.abs(response.rest).max() < 0.02
