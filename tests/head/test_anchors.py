import numpy as np
import pytest
import torch

from rgbavatar_ns.head import HeadModel, uv_anchors
from tests.head.synthetic_head import flame_shaped_arrays


def covering_triangles(uv: np.ndarray, uv_faces: np.ndarray, point: np.ndarray) -> list[int]:
    """Triangles of either orientation that hold the point, borders included, one by one."""
    found = []
    for index, corners in enumerate(uv[uv_faces]):
        signs = []
        for start, end in zip(corners, np.roll(corners, -1, 0)):
            edge, ray = end - start, point - start
            signs.append(edge[0] * ray[1] - edge[1] * ray[0])
        first, last = corners[1] - corners[0], corners[2] - corners[0]
        has_area = abs(first[0] * last[1] - first[1] * last[0]) > 1e-12
        if has_area and (min(signs) > -1e-12 or max(signs) < 1e-12):
            found.append(index)
    return found


@pytest.mark.parametrize("resolution", [1, 4, 7, 10, 15])
@pytest.mark.parametrize("mirrored", [False, True])
def test_agrees_with_point_in_triangle_by_hand(resolution: int, mirrored: bool) -> None:
    arrays = flame_shaped_arrays()
    # Half of the square, so that some texels stay bare; the degenerate triangle is in it.
    uv = arrays.uv * [0.8, 0.6] + [0.1, 0.25]
    uv = uv * [-1, 1] + [1, 0] if mirrored else uv
    faces = torch.tensor(arrays.uv_faces)
    anchors = uv_anchors(torch.tensor(uv), faces, resolution)
    wanted = {}
    for row in range(resolution):
        for column in range(resolution):
            centre = np.array([(column + 0.5) / resolution, 1 - (row + 0.5) / resolution])
            inside = covering_triangles(uv, arrays.uv_faces, centre)
            if inside:
                wanted[row, column] = inside[0]
    rows_and_columns = [tuple(texel) for texel in anchors.texel_row_col.tolist()]
    assert dict(zip(rows_and_columns, anchors.triangle_index.tolist())) == wanted
    assert rows_and_columns == sorted(wanted)


@pytest.mark.parametrize("resolution", [128, 255, 256])
def test_barycentrics_of_the_embedded_head_give_the_texel_centres(resolution: int) -> None:
    head = HeadModel.embedded()
    anchors = uv_anchors(head.uv, head.uv_faces, resolution)
    corners = head.uv.double()[head.uv_faces[anchors.triangle_index]]
    found = (anchors.barycentric.double()[..., None] * corners).sum(1)
    row, column = (anchors.texel_row_col.double().T + 0.5) / resolution
    torch.testing.assert_close(found, torch.stack([column, 1 - row], 1), atol=2e-7, rtol=0)
    assert anchors.barycentric.min() >= 0
    torch.testing.assert_close(anchors.barycentric.sum(1), torch.ones(len(found)))
    texels = anchors.texel_row_col[:, 0] * resolution + anchors.texel_row_col[:, 1]
    assert (texels.diff() > 0).all()


def test_at_256_about_sixty_thousand_texels_are_covered_every_part_among_them() -> None:
    head = HeadModel.embedded()
    anchors = uv_anchors(head.uv, head.uv_faces, 256)
    assert 58_000 < len(anchors.triangle_index) < 63_000
    vertices = head.faces[anchors.triangle_index, 0].numpy()
    for part, group in head.arrays.vertex_groups.items():
        assert np.isin(vertices, group).sum() > 500, part


def test_a_shared_edge_goes_to_the_first_triangle_and_leaves_no_gap() -> None:
    uv = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    for faces in ([[0, 1, 2], [0, 2, 3]], [[0, 2, 3], [0, 1, 2]]):
        anchors = uv_anchors(uv, torch.tensor(faces), 4)
        assert len(anchors.triangle_index) == 16
        row, column = anchors.texel_row_col.unbind(1)
        on_edge = row + column == 3
        assert (anchors.triangle_index[on_edge] == 0).all()


def test_a_map_without_area_carries_nothing() -> None:
    anchors = uv_anchors(torch.zeros(3, 2), torch.tensor([[0, 1, 2]]), 8)
    assert anchors.barycentric.shape == (0, 3)
    with pytest.raises(ValueError, match="resolution"):
        uv_anchors(torch.zeros(3, 2), torch.tensor([[0, 1, 2]]), 0)
