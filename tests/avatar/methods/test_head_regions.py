import numpy as np
import torch

from rgbavatar_ns.avatar.methods.head_regions import (
    MOUTH_GROUPS,
    faces_within,
    group_vertices,
    hull_mask,
)
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import PinholeCameras
from tests.avatar.small_head import front_camera, small_head_arrays


def wide_cameras() -> PinholeCameras:
    """Two cameras at the origin that look along +z; a metre away a metre is ten pixels."""
    shift = torch.eye(4).repeat(2, 1, 1)
    shift[1, 0, 3] = 0.2
    return PinholeCameras(
        shift, torch.full((2, 2), 10.0), torch.tensor([[6.0, 4.0]]).repeat(2, 1), 12, 8
    )


SQUARE = torch.tensor([[-0.3, -0.2, 1.0], [-0.3, 0.2, 1], [0.3, 0.2, 1], [0.3, -0.2, 1]])


def test_a_hull_holds_its_points_and_is_about_as_large() -> None:
    inside = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.1, 1.0]])
    points = torch.cat([SQUARE, inside])
    masks = hull_mask(points.expand(2, -1, -1), wide_cameras())
    square = torch.zeros(2, 8, 12, dtype=torch.bool)
    square[0, 2:6, 3:9] = True
    square[1, 2:6, 5:11] = True
    assert masks[square].all()
    # At most the ring of pixels that it touches more.
    assert masks.sum() <= 2 * (4 + 2) * (6 + 2)
    assert not hull_mask(points[None, :0], wide_cameras().select([0])).any()


def test_the_mouth_is_below_the_eyes_and_grows_as_the_jaw_opens() -> None:
    head = HeadModel.embedded()
    theta = torch.zeros(2, head.layout.size)
    theta[1, head.layout.slice("jaw").start] = 0.4
    vertices, camera = head(theta), front_camera(128)
    shift = torch.from_numpy(head.arrays.v_template).float().mean(0)
    vertices = vertices - shift
    mouth = hull_mask(vertices[:, group_vertices(head.arrays, MOUTH_GROUPS)], camera)
    eyes = hull_mask(vertices[:, group_vertices(head.arrays, ("left_eye", "right_eye"))], camera)
    area = mouth.sum((1, 2))
    assert 100 < area[0] < 128 * 128 / 10
    assert area[1] > 1.2 * area[0]
    rows, above = (np.flatnonzero(mask[0].any(1)) for mask in (mouth, eyes))
    assert above.max() < rows.min()


def test_a_head_without_groups_has_no_mouth() -> None:
    arrays = small_head_arrays()
    found = group_vertices(arrays, MOUTH_GROUPS)
    assert found.shape == (0,)
    faces = torch.from_numpy(arrays.faces)
    assert not faces_within(arrays, faces, "upper_teeth").any()
    assert faces_within(arrays, faces, "skin").all()
    assert group_vertices(arrays, ["skin"]).tolist() == list(range(len(arrays.v_template)))
    vertices = torch.from_numpy(arrays.v_template)[None]
    assert not hull_mask(vertices[:, found], front_camera()).any()
