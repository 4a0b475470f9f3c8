import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import Delaunay

from rgbavatar_ns.avatar.methods.triangle_walk import TriangleWalk, triangle_neighbours
from rgbavatar_ns.head import HeadModel
from tests.head.synthetic_head import grid_faces

DOUBLE = torch.float64


def flat_mesh(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Random triangles, every other one turned, over the square from 0 to 1."""
    generator = np.random.default_rng(seed)
    side = np.linspace(0, 1, 6)
    rim = [np.stack(pair, 1) for s in (0 * side, 0 * side + 1) for pair in ((side, s), (s, side))]
    points = np.concatenate([np.unique(np.concatenate(rim), axis=0), generator.random((60, 2))])
    faces = Delaunay(points).simplices
    faces[::2] = faces[::2, [1, 2, 0]]
    return torch.tensor(np.pad(points, ((0, 0), (0, 1)))), torch.tensor(faces, dtype=torch.int64)


def starts(faces: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    triangle = torch.randint(0, len(faces), (count,), generator=generator)
    barycentric = torch.rand(count, 3, generator=generator, dtype=DOUBLE)
    return triangle, barycentric / barycentric.sum(1, keepdim=True)


def at(vertices: torch.Tensor, faces: torch.Tensor, triangle, barycentric) -> torch.Tensor:
    return (vertices[faces[triangle]] * barycentric[..., None]).sum(1)


def change_for(vertices, faces, triangle, way: torch.Tensor) -> torch.Tensor:
    """Barycentric coordinates of a way in the triangles' own planes, by least squares."""
    corners = vertices[faces[triangle]].mT
    system = torch.cat([corners, torch.ones(len(way), 1, 3, dtype=DOUBLE)], 1)
    wanted = torch.cat([way, torch.zeros(len(way), 1, dtype=DOUBLE)], 1)
    return torch.linalg.lstsq(system, wanted[..., None], driver="gelsd").solution[..., 0]


def test_on_a_flat_mesh_a_walk_ends_where_straight_motion_does_and_at_the_border_otherwise():
    vertices, faces = flat_mesh()
    triangle, barycentric = starts(faces, 500)
    way = torch.zeros(500, 3, dtype=DOUBLE)
    generator = torch.Generator().manual_seed(2)
    way[:, :2] = 0.5 * torch.randn(500, 2, generator=generator, dtype=DOUBLE)
    change = change_for(vertices, faces, triangle, way)
    begun = at(vertices, faces, triangle, barycentric)
    arrived, places = TriangleWalk(vertices, faces)(triangle, barycentric, change)
    assert places.min() >= 0
    torch.testing.assert_close(places.sum(1), torch.ones(500, dtype=DOUBLE))
    found, aim = at(vertices, faces, arrived, places), begun + way
    inside = ((aim >= 0) & (aim <= 1)).all(1)
    assert 100 < inside.sum() < 400
    torch.testing.assert_close(found, aim.clamp(0, 1))
    assert (arrived != triangle).sum() > 300


def test_a_walk_does_not_notice_that_the_mesh_is_rolled_up():
    side = 9
    faces = torch.tensor(grid_faces(side), dtype=torch.int64)
    y, x = (part.ravel() for part in np.divmod(np.arange(side**2), side))
    flat = torch.tensor(np.stack([x, y, 0 * x], 1), dtype=DOUBLE)
    # Strips of length one, each turned by 40 degrees against the last: no triangle is stretched.
    turn = 0.7 * np.arange(side - 1)
    strips = np.stack([np.cos(turn), np.sin(turn)], 1)
    rolled = np.cumsum(np.concatenate([np.zeros((1, 2)), strips]), axis=0)
    folded = torch.tensor(np.stack([rolled[x, 0], y, rolled[x, 1]], 1))
    triangle, barycentric = starts(faces, 200)
    way = torch.zeros(200, 3, dtype=DOUBLE)
    generator = torch.Generator().manual_seed(2)
    way[:, :2] = 3 * torch.randn(200, 2, generator=generator, dtype=DOUBLE)
    change = change_for(flat, faces, triangle, way)
    on_flat, on_folded = (
        TriangleWalk(mesh, faces)(triangle, barycentric, change) for mesh in (flat, folded)
    )
    torch.testing.assert_close(at(flat, faces, *on_folded), at(flat, faces, *on_flat))


def test_without_a_change_or_within_the_triangle_nothing_is_crossed():
    vertices, faces = flat_mesh()
    triangle, barycentric = starts(faces, 50)
    walk = TriangleWalk(vertices, faces)
    arrived, places = walk(triangle, barycentric.float(), torch.zeros(50, 3))
    assert torch.equal(arrived, triangle)
    assert places.dtype == torch.float32
    torch.testing.assert_close(places, barycentric.float())
    centre = torch.full_like(barycentric, 1 / 3)
    arrived, places = walk(triangle, barycentric, centre - barycentric)
    assert torch.equal(arrived, triangle)
    torch.testing.assert_close(places, centre)


def test_on_a_head_walks_stay_on_the_surface_and_are_as_long_as_they_should_be():
    head = HeadModel.embedded(DOUBLE)
    vertices = head(torch.zeros(head.layout.size, dtype=DOUBLE))
    triangle, barycentric = starts(head.faces, 300)
    change = 0.5 * torch.randn(300, 3, generator=torch.Generator().manual_seed(5), dtype=DOUBLE)
    change = change - change.mean(1, keepdim=True)
    way = (vertices[head.faces[triangle]] * change[..., None]).sum(1)
    arrived, places = TriangleWalk(vertices, head.faces)(triangle, barycentric, change)
    moved = at(vertices, head.faces, arrived, places) - at(
        vertices, head.faces, triangle, barycentric
    )
    # On a curved surface and at borders the straight distance is at most the way.
    assert (moved.norm(dim=1) <= way.norm(dim=1) * (1 + 1e-9) + 1e-12).all()
    near = moved.norm(dim=1) > 0.8 * way.norm(dim=1)
    assert near.double().mean() > 0.9


def test_neighbours_are_trimeshs():
    head = HeadModel.embedded()
    found = triangle_neighbours(head.faces)
    mesh = trimesh.Trimesh(np.zeros((5409, 3)), head.faces.numpy(), process=False)
    counted = np.bincount(mesh.face_adjacency.ravel(), minlength=len(head.faces))
    np.testing.assert_array_equal((found >= 0).sum(1), counted)
    one, other = torch.tensor(mesh.face_adjacency).T
    assert (found[one] == other[:, None]).any(1).all()


@pytest.mark.parametrize("flat", ["no area", "three at an edge"])
def test_what_cannot_be_walked_into_is_a_border(flat: str):
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.5, 0], [1, 1, 1]])
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    if flat != "no area":
        vertices[3] = torch.tensor([1.0, 1, 0])
        faces = torch.tensor([[0, 1, 2], [1, 3, 2], [1, 4, 2]])
    walk = TriangleWalk(vertices, faces)
    middle = torch.full((1, 3), 1 / 3)
    arrived, places = walk(torch.tensor([0]), middle, torch.tensor([[-1.0, 0.6, 0.4]]))
    assert arrived.tolist() == [0]
    # Straight to (.93, .73), of which what leads across x + y = 1 is lost.
    torch.testing.assert_close(places, torch.tensor([[0.0, 0.6, 0.4]]))
