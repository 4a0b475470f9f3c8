import pytest
import torch
import torch.nn.functional as F

from rgbavatar_ns.avatar.methods.carriers import SmoothSurface, edge_frames, skinning_frames
from rgbavatar_ns.avatar.model.tangent_to_world import carried
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, quat_wxyz_to_matrix

DOUBLE = torch.float64
N = 40


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.embedded(DOUBLE)


def normal(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def posed(head: HeadModel) -> torch.Tensor:
    return head(0.2 * normal(2, head.layout.size, seed=3))


def places(head: HeadModel) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(4)
    triangle = torch.randint(0, len(head.faces), (N,), generator=generator)
    barycentric = torch.rand(N, 3, generator=generator, dtype=DOUBLE) + 0.05
    return triangle, barycentric / barycentric.sum(1, keepdim=True)


def local_gaussians() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return normal(1, N, 3), F.normalize(normal(1, N, 4, seed=5), dim=-1), normal(1, N, 3, seed=6)


def by_edges(head: HeadModel, vertices: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return carried(*local_gaussians(), edge_frames(vertices, head.faces, places(head)[0]))


def by_surface(head: HeadModel, vertices: torch.Tensor) -> tuple[torch.Tensor, ...]:
    surface = SmoothSurface(head(torch.zeros(head.layout.size, dtype=DOUBLE)), head.faces)
    frames = surface.frames(vertices, *places(head))
    position, rotation_wxyz, log_scale = local_gaussians()
    scales = (log_scale * frames.area_ratio[..., None]).exp()
    return frames.means(0.01 * position[..., 0]), frames.turned(rotation_wxyz), scales


@pytest.mark.parametrize("carry", [by_edges, by_surface])
def test_rigid_motion_of_the_mesh_moves_gaussians_rigidly(head: HeadModel, carry) -> None:
    vertices = posed(head)
    # The last is a turn by nearly 180 degrees, where quaternions change their sign.
    for axis_angle in ([0.3, -0.8, 0.5], [0.0, 3.1, 0.0], [2.2, 0.0, 2.2]):
        turn = axis_angle_to_matrix(torch.tensor(axis_angle, dtype=DOUBLE))
        shift = torch.tensor([0.1, -0.2, 0.3], dtype=DOUBLE)
        means, quats, scales = carry(head, vertices)
        moved, turned, same = carry(head, vertices @ turn.T + shift)
        torch.testing.assert_close(moved, means @ turn.T + shift)
        torch.testing.assert_close(quat_wxyz_to_matrix(turned), turn @ quat_wxyz_to_matrix(quats))
        torch.testing.assert_close(same, scales)


def test_edge_frame_by_hand() -> None:
    # Edge of length 4 along +y, height 2 along -x, so that the normal is +z.
    vertices = torch.tensor([[[0.0, 0, 0], [0, 4, 0], [-2, 1, 0]]])
    frames = edge_frames(vertices, torch.tensor([[0, 1, 2]]), torch.tensor([0]))
    rotation = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    torch.testing.assert_close(frames.matrix[0, 0], 3 * rotation)
    torch.testing.assert_close(quat_wxyz_to_matrix(frames.quat_wxyz[0, 0]), rotation)
    torch.testing.assert_close(frames.origin[0, 0], torch.tensor([-2 / 3, 5 / 3, 0]))
    assert frames.length_ratio is not None
    assert frames.length_ratio.item() == pytest.approx(3)


def test_edge_frames_gaussians_grow_with_the_mesh(head: HeadModel) -> None:
    vertices = posed(head)
    means, quats, scales = by_edges(head, vertices)
    grown = by_edges(head, 1.7 * vertices)
    torch.testing.assert_close(grown[0], 1.7 * means)
    torch.testing.assert_close(grown[1], quats)
    torch.testing.assert_close(grown[2], 1.7 * scales)


def test_triangles_without_area_carry_finite_gaussians_with_finite_gradients() -> None:
    vertices = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]]], requires_grad=True)
    faces = torch.tensor([[0, 1, 3], [0, 1, 2], [3, 3, 3]])
    frames = edge_frames(vertices, faces, torch.arange(3))
    surface = SmoothSurface(vertices[0], faces).frames(vertices, torch.arange(3), torch.ones(3, 3))
    parts = [*vars(frames).values(), *vars(surface).values()]
    assert all(part.isfinite().all() for part in parts)
    sum(part.sin().sum() for part in parts).backward()
    assert vertices.grad is not None
    assert vertices.grad.isfinite().all()


def test_the_smooth_surface_at_rest_leaves_gaussians_as_they_are(head: HeadModel) -> None:
    rest = head(torch.zeros(1, head.layout.size, dtype=DOUBLE))
    triangle, barycentric = places(head)
    frames = SmoothSurface(rest[0], head.faces).frames(rest, triangle, barycentric)
    flat = (rest[:, head.faces[triangle]] * barycentric[..., None]).sum(2)
    torch.testing.assert_close(frames.means(torch.zeros(1, N, dtype=DOUBLE)), flat)
    identity = torch.tensor([1.0, 0, 0, 0], dtype=DOUBLE).expand(1, N, 4)
    torch.testing.assert_close(frames.quat_wxyz, identity)
    torch.testing.assert_close(frames.area_ratio, torch.ones(1, N, dtype=DOUBLE))


def test_growth_of_the_mesh_is_growth_of_areas_and_turns_nothing(head: HeadModel) -> None:
    vertices = posed(head)
    rest = head(torch.zeros(head.layout.size, dtype=DOUBLE))
    surface = SmoothSurface(rest, head.faces, damping_m2=0.0)
    before, after = (surface.frames(k * vertices, *places(head)) for k in (1, 1.5))
    torch.testing.assert_close(after.area_ratio, 2.25 * before.area_ratio)
    torch.testing.assert_close(after.quat_wxyz, before.quat_wxyz)
    torch.testing.assert_close(after.normal, before.normal)
    damped = SmoothSurface(rest, head.faces, damping_m2=1.0).frames(vertices, *places(head))
    assert (damped.area_ratio - 1).abs().max() < 1e-3


def test_vertices_turn_as_the_mean_of_the_triangles_around_by_area_at_rest() -> None:
    # Two squares side by side, the right one of half the width; it is bent up about their edge.
    rest = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [3, 0, 0], [3, 2, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])
    vertices = rest.clone()
    vertices[4:, 0], vertices[4:, 2] = 2.0, 1.0
    quats = SmoothSurface(rest, faces).vertex_quats_wxyz(vertices[None])[0]
    up = 0.5**0.5 * torch.tensor([1.0, 0, -1, 0])
    still = torch.tensor([1.0, 0, 0, 0])
    torch.testing.assert_close(quats[0], still)
    torch.testing.assert_close(quats[5], up)
    # At vertex 1 meet 2 of the left, 1 + 1 of the right; at vertex 2, 2 + 2 and 1.
    torch.testing.assert_close(quats[1], F.normalize(2 * still + 2 * up, dim=0))
    torch.testing.assert_close(quats[2], F.normalize(4 * still + up, dim=0))


def test_skinning_by_the_heads_weights_carries_points_as_the_head_does(head: HeadModel) -> None:
    theta = 0.3 * normal(2, head.layout.size, seed=8)
    still = theta.clone()
    for name in ("rotation", "neck", "jaw", "left_eye", "right_eye", "translation"):
        still[:, head.layout.slice(name)] = 0
    weights = torch.tensor(head.arrays.skinning_weights, dtype=DOUBLE)
    frames = skinning_frames(weights, head.joint_transforms(theta))
    identity, zero = torch.tensor([1.0, 0, 0, 0], dtype=DOUBLE), torch.zeros(1, 1, 3, dtype=DOUBLE)
    count = len(weights)
    means, _, scales = carried(
        head(still), identity.expand(1, count, 4), zero.expand(1, count, 3), frames
    )
    assert not head.arrays.posedirs.any()
    torch.testing.assert_close(means, head(theta), atol=1e-6, rtol=0)
    assert (scales == 1).all()


def test_what_bones_carry_moves_rigidly_with_them_and_near_the_nearest_rotation() -> None:
    weights = normal(N, 3).square()
    weights = weights / weights.sum(1, keepdim=True)
    axes = F.normalize(normal(2, 3, 3, seed=9), dim=-1)
    turns = axis_angle_to_matrix(torch.tensor(12.5).deg2rad() * axes)
    transforms = torch.eye(4, dtype=DOUBLE).repeat(2, 3, 1, 1)
    transforms[..., :3, :3], transforms[..., :3, 3] = turns, normal(2, 3, 3, seed=10)
    frames = skinning_frames(weights, transforms)
    left, _, right = torch.linalg.svd(frames.matrix)
    # Bones at most 25 degrees apart: the quaternion is within half a degree of the polar rotation.
    apart = quat_wxyz_to_matrix(frames.quat_wxyz).mT @ (left @ right)
    assert ((apart.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).acos().rad2deg().max() < 0.5
    motion = torch.eye(4, dtype=DOUBLE)
    motion[:3, :3] = axis_angle_to_matrix(torch.tensor([0.4, 1.5, -0.2], dtype=DOUBLE))
    motion[:3, 3] = torch.tensor([1.0, 2, 3], dtype=DOUBLE)
    alike = skinning_frames(weights, motion.expand(2, 3, 4, 4))
    torch.testing.assert_close(alike.matrix, motion[:3, :3].expand(2, N, 3, 3))
    torch.testing.assert_close(
        quat_wxyz_to_matrix(alike.quat_wxyz), motion[:3, :3].expand(2, N, 3, 3)
    )
    both = skinning_frames(weights, motion @ transforms)
    torch.testing.assert_close(both.matrix, motion[:3, :3] @ frames.matrix)
    torch.testing.assert_close(both.origin, frames.origin @ motion[:3, :3].T + motion[:3, 3])


def test_gradients_agree_with_differences() -> None:
    vertices = normal(2, 5, 3).requires_grad_()
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [4, 2, 3]])
    triangle = torch.tensor([2, 0, 1, 1])
    surface = SmoothSurface(normal(5, 3, seed=2), faces)
    barycentric = normal(4, 3, seed=11).requires_grad_()
    weights = normal(4, 2, seed=12).square().requires_grad_()
    bones = torch.eye(4, dtype=DOUBLE) + 0.1 * normal(2, 2, 4, 4, seed=13)

    def parts(vertices, barycentric, weights, bones):
        edges = edge_frames(vertices, faces, triangle)
        smooth = surface.frames(vertices, triangle, barycentric)
        skinned = skinning_frames(weights, bones)
        found = [*vars(edges).values(), *vars(smooth).values(), *vars(skinned).values()]
        return tuple(part for part in found if part is not None)

    inputs = (vertices, barycentric, weights, bones.requires_grad_())
    assert torch.autograd.gradcheck(parts, inputs, fast_mode=True)
