import numpy as np
import pytest
import torch
import trimesh

from rgbavatar_ns.head import HeadModel, edge_rotations, frame_quats_wxyz, tangent_frames
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.kernels.reference import rotation_matrices

VARIANTS = ("normalized", "raw", "orthonormal")


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.embedded(torch.float64)


@pytest.fixture(scope="module")
def posed(head: HeadModel) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    theta = torch.rand(2, head.layout.size, generator=generator, dtype=torch.float64) * 0.2
    return head(theta)


def frames_of(head: HeadModel, vertices: torch.Tensor, variant) -> torch.Tensor:
    return tangent_frames(vertices, head.faces, head.uv, head.uv_faces, variant)


def test_raw_columns_are_the_derivatives_of_the_surface_by_u_and_v(
    head: HeadModel, posed: torch.Tensor
) -> None:
    frames = frames_of(head, posed[0], "raw")
    corners = head.uv[head.uv_faces]
    points = posed[0][head.faces]
    # The surface over a triangle is linear in (u, v): solve for it with a constant term.
    system = torch.cat([corners, torch.ones_like(corners[..., :1])], -1)

    def position(at_uv: torch.Tensor) -> torch.Tensor:
        weights = torch.linalg.solve(system.mT, torch.cat([at_uv, torch.ones(len(at_uv), 1)], -1))
        return (weights[..., None] * points).sum(1)

    centre, step = corners.mean(1), 1e-3
    for axis in range(2):
        shift = step * torch.eye(2, dtype=torch.float64)[axis]
        difference = (position(centre + shift) - position(centre - shift)) / (2 * step)
        torch.testing.assert_close(frames[..., axis], difference, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("variant", VARIANTS)
def test_normals_are_trimeshs(head: HeadModel, posed: torch.Tensor, variant) -> None:
    mesh = trimesh.Trimesh(posed[1].numpy(), head.faces.numpy(), process=False)
    normals = frames_of(head, posed, variant)[1, :, :, 2]
    np.testing.assert_allclose(normals, mesh.face_normals, atol=1e-9)


def test_normalized_columns_point_along_the_raw_ones(head: HeadModel, posed: torch.Tensor) -> None:
    raw, normalized = frames_of(head, posed, "raw"), frames_of(head, posed, "normalized")
    torch.testing.assert_close(raw / raw.norm(dim=-2, keepdim=True), normalized)


def test_orthonormal_frames_are_rotations_that_keep_n_and_the_direction_of_t(
    head: HeadModel, posed: torch.Tensor
) -> None:
    frames = frames_of(head, posed, "orthonormal")
    identity = torch.eye(3, dtype=torch.float64).expand_as(frames)
    torch.testing.assert_close(frames.mT @ frames, identity)
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones_like(frames[..., 0, 0]))
    normalized = frames_of(head, posed, "normalized")
    torch.testing.assert_close(frames[..., [0, 2]], normalized[..., [0, 2]])
    # The embedded map is not mirrored: B keeps its side.
    assert (frames[..., 1] * normalized[..., 1]).sum(-1).min() > 0


def test_rotations_by_edges_are_orthonormal_frames_without_a_map(
    head: HeadModel, posed: torch.Tensor
) -> None:
    found = edge_rotations(posed, head.faces)
    no_uv, no_faces = posed.new_zeros(1, 2), torch.zeros_like(head.faces)
    expected = tangent_frames(posed, head.faces, no_uv, no_faces, "orthonormal")
    torch.testing.assert_close(found, expected)
    along = posed[:, head.faces[:, 1]] - posed[:, head.faces[:, 0]]
    torch.testing.assert_close(found[..., 0], along / along.norm(dim=-1, keepdim=True))
    nothing = edge_rotations(torch.zeros(1, 3, 3), torch.tensor([[0, 1, 2]]))
    assert torch.equal(nothing[0, 0], torch.eye(3))


def test_quaternions_of_orthonormal_frames_reproduce_them(
    head: HeadModel, posed: torch.Tensor
) -> None:
    frames = frames_of(head, posed, "orthonormal")
    torch.testing.assert_close(rotation_matrices(frame_quats_wxyz(frames)), frames)


@pytest.mark.parametrize("variant", ["normalized", "raw"])
def test_quaternions_are_the_nearest_rotation_that_keeps_the_normal(
    head: HeadModel, posed: torch.Tensor, variant
) -> None:
    frames = frames_of(head, posed, variant)[0, ::50]
    rotation = rotation_matrices(frame_quats_wxyz(frames))
    torch.testing.assert_close(rotation[..., 2], frames[..., 2])
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(len(frames)).double())
    distance = (rotation - frames).square().sum((1, 2))
    for angle in torch.linspace(-3, 3, 41, dtype=torch.float64):
        turn = axis_angle_to_matrix(angle * frames[..., 2])
        other = (turn @ rotation - frames).square().sum((1, 2))
        assert (other >= distance * (1 - 1e-9)).all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_frames_turn_with_the_head(head: HeadModel, posed: torch.Tensor, variant) -> None:
    turn = axis_angle_to_matrix(torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64))
    moved = posed @ turn.T + torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    frames = frames_of(head, posed, variant)
    torch.testing.assert_close(frames_of(head, moved, variant), turn @ frames)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("variant", VARIANTS)
def test_triangles_without_area_stay_finite_with_finite_gradients(variant, dtype) -> None:
    # Good; no area in UV; a line in UV; a line in space; a point in space; both a point.
    vertices = torch.tensor(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [0, 0, 1]], dtype=dtype, requires_grad=True
    )
    uv = torch.tensor([[0, 0], [1, 0], [0, 1], [0.3, 0], [0.6, 0]], dtype=dtype)
    faces = torch.tensor([[0, 1, 2], [0, 1, 2], [0, 1, 4], [0, 1, 3], [4, 4, 4], [2, 2, 2]])
    uv_faces = torch.tensor([[0, 1, 2], [1, 1, 1], [0, 3, 4], [0, 1, 2], [0, 1, 2], [0, 0, 0]])
    frames = tangent_frames(vertices, faces, uv, uv_faces, variant)
    quats = frame_quats_wxyz(frames)
    assert torch.equal(frames[0], torch.eye(3, dtype=dtype))
    assert frames.isfinite().all()
    torch.testing.assert_close(quats.norm(dim=-1), torch.ones(6, dtype=dtype))
    (frames.sin().sum() + quats.sin().sum()).backward()
    assert vertices.grad is not None
    assert vertices.grad.isfinite().all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradients_agree_with_differences(variant) -> None:
    generator = torch.Generator().manual_seed(1)
    vertices = torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
    uv = torch.rand(5, 2, generator=generator, dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [4, 2, 3]])

    def both(vertices: torch.Tensor) -> torch.Tensor:
        frames = tangent_frames(vertices, faces, uv, faces, variant)
        return torch.cat([frames.flatten(), frame_quats_wxyz(frames).flatten()])

    assert torch.autograd.gradcheck(both, (vertices.requires_grad_(),))


def test_a_mirrored_map_still_gives_proper_rotations() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.2, 1, 0.3]])
    uv, face = torch.tensor([[1.0, 0], [0, 0], [0.7, 1]]), torch.tensor([[0, 1, 2]])
    for variant in VARIANTS:
        frames = tangent_frames(vertices, face, uv, face, variant)
        rotation = rotation_matrices(frame_quats_wxyz(frames))
        torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(1))
        torch.testing.assert_close(rotation[..., 2], frames[..., 2])
