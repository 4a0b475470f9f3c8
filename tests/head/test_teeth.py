"""Teeth on a FLAME-shaped head: counts, order, joints, winding and UV strip."""

import numpy as np
import pytest
import torch

from rgbavatar_ns.head import HeadArrays, uv_anchors
from rgbavatar_ns.head.flame import load_flame
from rgbavatar_ns.head.teeth import LOWER_LIP, UPPER_LIP, with_teeth
from rgbavatar_ns.synthetic.flame import write_synthetic_flame


@pytest.fixture(scope="module")
def toothless(tmp_path_factory) -> HeadArrays:
    return load_flame(write_synthetic_flame(tmp_path_factory.mktemp("flame")), teeth=False)


FORMS = pytest.mark.parametrize(
    ("form", "vertices", "triangles"), [("strips", 60, 56), ("blocks", 120, 168)]
)


@FORMS
def test_counts_are_those_of_the_release_and_of_vhap(toothless, form, vertices, triangles):
    head = with_teeth(toothless, form)
    assert len(head.v_template) == 5023 + vertices
    assert len(head.faces) == len(head.uv_faces) == 9976 + triangles
    assert len(np.unique(head.faces[9976:])) == vertices
    for group, joint in (("upper_teeth", 1), ("lower_teeth", 2)):
        members = head.vertex_groups[group]
        assert len(members) == vertices // 2
        assert np.array_equal(
            head.skinning_weights[members], np.tile(np.eye(5)[joint], (len(members), 1))
        )


def test_rows_come_in_vhaps_order(toothless):
    """Upper root, lower root, upper edge, lower edge, then behind: upper both, lower both."""
    rows = with_teeth(toothless, "blocks").v_template[5023:].reshape(8, 15, 3)
    height, depth = rows[..., 1].mean(1), rows[..., 2].mean(1)
    assert height[0] > height[3] > height[2] > height[1], "the upper edge bites over the lower"
    assert np.allclose(height[4:], height[[0, 2, 1, 3]])
    assert np.allclose(depth[[0, 1, 2, 3]] - depth[[4, 6, 5, 7]], depth[0] - depth[4])
    assert (np.diff(rows[..., 0], axis=1) < 0).all(), "from the subject's left to the right"
    strips = with_teeth(toothless, "strips").v_template[5023:]
    assert np.array_equal(strips, rows[:4].reshape(60, 3))


def test_teeth_lie_behind_the_lips_at_the_mouths_height(toothless):
    teeth = with_teeth(toothless).v_template[5023:]
    upper, lower = toothless.v_template[list(UPPER_LIP)], toothless.v_template[list(LOWER_LIP)]
    middle = (upper + lower) / 2
    assert (teeth.reshape(4, 15, 3)[..., 2] < middle[:, 2] - 4e-3).all()
    assert abs(teeth[:, 1].mean() - middle[:, 1].mean()) < 5e-3
    assert 5e-3 < np.ptp(teeth[:30, 1]) < 25e-3


@FORMS
def test_triangles_face_outward(toothless, form, vertices, triangles):
    """Front faces forward, back backward, biting edges down (upper) and up (lower)."""
    head = with_teeth(toothless, form)
    corners = head.v_template[head.faces[9976:]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    wanted = [(2, 1), (2, 1), (2, -1), (2, -1), (1, -1), (1, 1)][: triangles // 28]
    for strip, (axis, sign) in enumerate(wanted):
        assert (sign * normal[28 * strip : 28 * (strip + 1), axis] > 0).all(), strip


@FORMS
def test_identity_moves_them_as_the_lips_mean_and_nothing_else_does(
    toothless, form, vertices, triangles
):
    head = with_teeth(toothless, form)
    lips = (toothless.shapedirs[list(UPPER_LIP)] + toothless.shapedirs[list(LOWER_LIP)]) / 2
    rows = head.shapedirs[5023:].reshape(vertices // 15, 15, 3, 400)
    assert np.allclose(rows[..., :300], lips[None, ..., :300])
    assert not rows[..., 300:].any()
    assert not head.posedirs[5023:].any()
    assert head.eyelid_dirs is not None
    assert not head.eyelid_dirs[5023:].any()
    assert not head.joint_regressor[:, 5023:].any()
    assert np.array_equal(head.shapedirs[:5023], toothless.shapedirs)


@FORMS
def test_their_uv_strips_overlap_nothing(toothless, form, vertices, triangles):
    head = with_teeth(toothless, form)
    corners = head.uv[head.uv_faces[9976:]].astype(np.float64)
    assert corners[..., 0].min() == pytest.approx(0.25)
    assert corners[..., 0].max() == pytest.approx(0.75)
    assert corners[..., 1].min() >= 0.955 - 1e-6
    assert corners[..., 1].max() <= 0.995 + 1e-6
    area = abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 2
    anchors = uv_anchors(torch.from_numpy(head.uv), torch.from_numpy(head.uv_faces), 1024)
    texels = (anchors.triangle_index >= 9976).sum().item()
    assert texels / 1024**2 == pytest.approx(area, rel=0.05)
