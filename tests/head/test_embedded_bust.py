"""What the embedded bust must be: the same head to the bit, on shoulders that the root carries."""

import numpy as np
import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import EMBEDDED_BUST, EMBEDDED_HEAD, HeadArrays, HeadModel, uv_anchors
from rgbavatar_ns.head.arrays import BODY_IDENTITY, NECK_SHIFTS

CM, MM = 1e-2, 1e-3


@pytest.fixture(scope="module")
def bust() -> HeadModel:
    return HeadModel.embedded(torch.float64, EMBEDDED_BUST)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.embedded(torch.float64, EMBEDDED_HEAD)


def test_its_head_is_the_embedded_one_in_every_pose(bust: HeadModel, head: HeadModel) -> None:
    count = len(head.arrays.v_template)
    drawn = torch.Generator().manual_seed(0)
    parts = {
        name: 0.3 * torch.randn(4, size, generator=drawn, dtype=torch.float64)
        for name, size in ((field.name, field.size) for field in head.layout.fields)
    }
    identity = torch.randn(head.num_identity, generator=drawn, dtype=torch.float64)
    alone = head(head.layout.join(parts), identity)
    more = torch.zeros(4, len(NECK_SHIFTS), dtype=torch.float64)
    parts["expression"] = torch.cat([parts["expression"], more], 1)
    average = torch.zeros(len(BODY_IDENTITY), dtype=torch.float64)
    on_shoulders = bust(bust.layout.join(parts), torch.cat([identity, average]))
    torch.testing.assert_close(on_shoulders[:, :count], alone, atol=1e-9, rtol=0)
    triangles = len(head.arrays.faces)
    assert np.array_equal(bust.arrays.faces[:triangles], head.arrays.faces)


def test_a_turn_of_the_neck_leaves_the_shoulders_where_they_are(bust: HeadModel) -> None:
    theta = torch.zeros(bust.layout.size, dtype=torch.float64)
    theta[bust.layout.slice("neck")] = torch.tensor([0.2, 0.5, 0.1], dtype=torch.float64)
    moved = np.linalg.norm(bust(theta).numpy() - bust.arrays.v_template, axis=1)
    shoulders = bust.arrays.v_template[:, 1] < -0.22
    assert shoulders.sum() > 800
    assert moved[shoulders].max() < 0.01 * MM
    assert moved[bust.arrays.vertex_groups["upper_teeth"]].min() > 20 * MM


def test_a_turn_of_the_root_turns_everything_alike(bust: HeadModel) -> None:
    theta = torch.zeros(bust.layout.size, dtype=torch.float64)
    theta[bust.layout.slice("rotation")] = torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64)
    root = bust.joints()[0].numpy()
    c, s = np.cos(0.5), np.sin(0.5)
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    wanted = (bust.arrays.v_template - root) @ about_y.T + root
    np.testing.assert_allclose(bust(theta).numpy(), wanted, atol=1e-6)


@pytest.mark.parametrize("axis", range(3))
def test_a_neck_shift_carries_the_head_a_centimetre_and_no_shoulder(
    bust: HeadModel, axis: int
) -> None:
    theta = torch.zeros(bust.layout.size, dtype=torch.float64)
    column = bust.arrays.expression_names.index(NECK_SHIFTS[axis])
    theta[bust.layout.slice("expression").start + column] = 1.0
    moved = bust(theta).numpy() - bust.arrays.v_template
    for part in ("upper_teeth", "left_eye", "lower_teeth"):
        group = bust.arrays.vertex_groups[part]
        np.testing.assert_allclose(moved[group], np.tile(np.eye(3)[axis] * CM, (len(group), 1)),
                                   atol=0.02 * MM)  # fmt: skip
    assert np.abs(moved[bust.arrays.v_template[:, 1] < -0.22]).max() < 0.01 * MM


def test_shoulders_go_up_and_apart_by_centimetres_and_leave_the_head(bust: HeadModel) -> None:
    left = bust.arrays.v_template[:, 0] > 0.16
    head = bust.arrays.skinning_weights[:, 0] < 1e-6
    theta = torch.zeros(bust.layout.size, dtype=torch.float64)
    for direction, axis in enumerate((1, 0)):
        person = torch.zeros(bust.num_identity, dtype=torch.float64)
        person[bust.num_identity - len(BODY_IDENTITY) + direction] = 2.0
        moved = bust(theta, person).numpy() - bust.arrays.v_template
        np.testing.assert_allclose(moved[left][:, axis], 2 * CM, atol=0.05 * MM)
        assert np.abs(moved[head]).max() < 0.01 * MM


def test_it_reaches_shoulders_and_chest_without_a_gap(bust: HeadModel) -> None:
    arrays = bust.arrays
    torso = arrays.v_template[arrays.vertex_groups["torso"]]
    assert torso[:, 0].max() - torso[:, 0].min() > 0.4, "both upper arms"
    assert torso[:, 1].min() < -0.35, "the breastbone's end"
    edges = np.sort(arrays.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 2
    rim = unique[counts == 1]
    neck = (arrays.v_template[rim].mean(1)[:, 1] < -0.1) & (
        arrays.v_template[rim].mean(1)[:, 1] > -0.3
    )
    assert not neck.any(), "the head's lower border is closed by the torso"


def test_its_texels_lie_on_the_torso_too_and_on_one_place_each(bust: HeadModel) -> None:
    arrays = bust.arrays
    anchors = uv_anchors(torch.from_numpy(arrays.uv), torch.from_numpy(arrays.uv_faces), 256)
    corners = arrays.faces[anchors.triangle_index.numpy()]
    on_torso = np.isin(corners, arrays.vertex_groups["torso"]).any(1)
    assert 50_000 < len(on_torso) < 66_000
    assert 0.12 < on_torso.mean() < 0.3
    # No two triangles share a place: their areas add up to what the texels cover.
    uv = arrays.uv[arrays.uv_faces].astype(np.float64)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert area.min() > 0, "no triangle is flipped"
    assert abs(area.sum() * 256**2 / len(on_torso) - 1) < 0.02


def test_there_is_no_other_embedded_head() -> None:
    with pytest.raises(UserError, match=r"No head model of the name 'bust'.*ships"):
        HeadArrays.embedded("bust")
    assert HeadArrays.embedded_as("FLAME 2020") is None
    assert HeadArrays.embedded_as(EMBEDDED_BUST) is HeadArrays.embedded(EMBEDDED_BUST)
