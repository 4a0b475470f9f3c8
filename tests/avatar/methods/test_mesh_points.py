import pytest
import torch

from rgbavatar_ns.avatar.methods.mesh_points import spread_points
from rgbavatar_ns.head import HeadModel

# Two rectangles apart, of 2 x 1 and 1 x 1 metres, of two triangles each, and one without area.
VERTICES = torch.tensor(
    [[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [9, 0, 0], [9, 0, 1], [9, 1, 1], [9, 1, 0]]
)
FACES = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 0, 1], [4, 5, 6], [4, 6, 7]])


def spread(count: int, seed: int = 0, vertices=VERTICES, faces=FACES):
    generator = torch.Generator().manual_seed(seed)
    triangle, barycentric = spread_points(vertices, faces, count, generator)
    return triangle, barycentric, (vertices[faces[triangle]] * barycentric[..., None]).sum(1)


@pytest.mark.parametrize("count", [1, 4, 300])
def test_as_many_points_as_asked_lie_on_the_mesh(count):
    triangle, barycentric, _ = spread(count)
    assert triangle.shape == (count,)
    assert barycentric.min() >= 0
    torch.testing.assert_close(barycentric.sum(1), torch.ones(count))
    assert 2 not in triangle.tolist()


def test_points_keep_apart_and_each_area_has_its_share():
    count = 3000
    triangle, _, places = spread(count)
    share = torch.bincount(triangle, minlength=5) / count
    torch.testing.assert_close(share, torch.tensor([1, 1, 0, 0.5, 0.5]) / 3, atol=0.01, rtol=0)
    nearest = torch.cdist(places, places).topk(2, largest=False).values[:, 1]
    # An area of 3 m^2: independent points have half its root over their number on average.
    unit = (3 / count) ** 0.5
    assert nearest.mean() > 1.45 * 0.5 * unit
    # All but those that had to fill up the number.
    assert (nearest > 0.69 * unit).float().mean() > 0.9


def test_points_are_those_of_the_seed():
    first, again, other = (spread(50, seed)[2] for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_the_whole_embedded_head_is_covered():
    head = HeadModel.embedded()
    rest = head(torch.zeros(head.layout.size))
    _, _, places = spread(2000, vertices=rest, faces=head.faces)
    corners = rest[head.faces]
    sides = corners[:, 1:] - corners[:, :1]
    area = 0.5 * torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=-1).sum()
    farthest = torch.cdist(corners.mean(1), places).amin(1).max()
    assert farthest < 2.5 * (area / 2000).sqrt()
