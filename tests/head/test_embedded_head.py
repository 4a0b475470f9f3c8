"""What the embedded head must be: anatomy, joints, UV map and landmarks."""

import numpy as np
import pytest
import torch

from rgbavatar_ns.head import SPARSE_51, HeadModel, facemesh_landmarks
from rgbavatar_ns.head.arrays import embedded_file

MM = 1e-3


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.embedded(torch.float64)


def posed(head: HeadModel, **values: float | list[float]) -> np.ndarray:
    """Vertices with these expressions (by name) and fields of theta."""
    theta = torch.zeros(head.layout.size, dtype=torch.float64)
    for name, value in values.items():
        known = head.arrays.expression_names
        place = head.layout.slice(name) if name in head.layout else known.index(name)
        theta[place] = torch.tensor(value, dtype=torch.float64)
    return head(theta).numpy()


def test_is_complete_and_small(head: HeadModel) -> None:
    arrays = head.arrays
    assert len(arrays.expression_names) == len(set(arrays.expression_names)) == 52
    assert {"jawOpen", "eyeBlinkLeft", "mouthSmileRight", "tongueOut"} <= set(
        arrays.expression_names
    )
    assert arrays.num_identity >= 20
    parts = {"skin", "left_eye", "right_eye", "upper_teeth", "lower_teeth", "tongue"}
    assert set(arrays.vertex_groups) == parts
    counts = sum(len(group) for group in arrays.vertex_groups.values())
    assert counts == len(arrays.v_template) == len(np.unique(arrays.faces))
    assert embedded_file().stat().st_size < 1_000_000
    assert "CC0" in (embedded_file().parent / "LICENSE").read_text()


def test_is_an_adult_head_in_metres_with_the_subjects_left_at_positive_x(head: HeadModel) -> None:
    arrays = head.arrays
    left, right = (arrays.v_template[arrays.vertex_groups[f"{s}_eye"]] for s in ("left", "right"))
    distance = left.mean(0) - right.mean(0)
    np.testing.assert_allclose(distance[1:], 0, atol=MM)
    assert 55 * MM < distance[0] < 70 * MM
    skin = arrays.v_template[arrays.vertex_groups["skin"]]
    assert skin[:, 1].max() - left[:, 1].mean() > 80 * MM, "the crown is above the eyes"
    nose_tip = skin[skin[:, 2].argmax()]
    assert abs(nose_tip[0]) < MM, "the nose is in the middle, in front"
    smile = posed(head, mouthSmileLeft=1.0) - arrays.v_template
    moved = np.linalg.norm(smile, axis=1)
    assert arrays.v_template[moved.argmax(), 0] > 0, "the left smile is on the left"


def test_triangles_face_outward_and_have_area(head: HeadModel) -> None:
    arrays = head.arrays
    corners = arrays.v_template[arrays.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(normals, axis=1).min() > 1e-9
    for part in ("left_eye", "right_eye", "tongue"):
        inside = np.isin(arrays.faces[:, 0], arrays.vertex_groups[part])
        volume = np.einsum("ij,ij->i", corners[inside, 0], normals[inside]).sum()
        assert volume > 0, part
    skin = np.isin(arrays.faces[:, 0], arrays.vertex_groups["skin"])
    foremost = skin & (corners.mean(1)[:, 2] > 0.068)
    assert (normals[foremost, 2] > 0).mean() > 0.9, "the tip of the nose faces forward"


def test_joints_come_from_the_mesh(head: HeadModel) -> None:
    arrays = head.arrays
    assert np.count_nonzero(arrays.joint_regressor, axis=1).max() < 300
    np.testing.assert_allclose(arrays.joint_regressor.sum(1), 1, atol=1e-6)
    np.testing.assert_allclose(arrays.skinning_weights.sum(1), 1, atol=1e-6)
    joints = head.joints().numpy()
    for joint, part in ((3, "left_eye"), (4, "right_eye")):
        eye = arrays.v_template[arrays.vertex_groups[part]]
        radius = np.linalg.norm(eye - joints[joint], axis=1)
        np.testing.assert_allclose(radius, radius.mean(), atol=0.1 * MM)
    np.testing.assert_allclose(joints[:3, 0], 0, atol=1e-6)
    root, neck, jaw = joints[:3]
    assert root[1] < neck[1] < jaw[1] < joints[3, 1]


def test_eye_joints_turn_the_eyeball_about_its_centre(head: HeadModel) -> None:
    arrays = head.arrays
    looking = posed(head, left_eye=[0.0, 0.4, 0.0])
    for part, turned in (("left_eye", True), ("right_eye", False)):
        group = arrays.vertex_groups[part]
        before, after = arrays.v_template[group], looking[group]
        np.testing.assert_allclose(after.mean(0), before.mean(0), atol=0.1 * MM)
        front = before[:, 2].argmax()
        # To the subject's left by the radius (14 mm) times sin(.4).
        assert (after[front, 0] - before[front, 0] > 4 * MM) == turned
    skin = arrays.vertex_groups["skin"]
    np.testing.assert_allclose(looking[skin], arrays.v_template[skin], atol=1e-9)


def test_the_jaw_takes_lower_teeth_tongue_and_chin_and_leaves_the_upper_face(
    head: HeadModel,
) -> None:
    arrays = head.arrays
    moved = np.linalg.norm(posed(head, jaw=[0.3, 0.0, 0.0]) - arrays.v_template, axis=1)
    groups = arrays.vertex_groups
    assert moved[groups["lower_teeth"]].min() > 5 * MM
    assert moved[groups["tongue"]].min() > 1 * MM
    assert moved[groups["upper_teeth"]].max() < 1e-6
    below_the_eyes = 10 * MM
    assert moved[arrays.v_template[:, 1] > below_the_eyes].max() < 1 * MM
    marks = facemesh_landmarks()
    corners = arrays.faces[marks.triangle[marks.facemesh_index.tolist().index(152)]]
    assert moved[corners].min() > 15 * MM


def test_the_jaw_joint_reproduces_the_sculpted_open_jaw(head: HeadModel) -> None:
    arrays = head.arrays
    teeth = arrays.vertex_groups["lower_teeth"]
    by_joint = posed(head, jaw=[np.radians(24.4), 0.0, 0.0])
    by_sculptor = posed(head, jawOpen=1.0)
    error = np.linalg.norm(by_joint - by_sculptor, axis=1)
    assert error[teeth].mean() < 1 * MM
    assert error[arrays.vertex_groups["skin"]].mean() < 1.5 * MM


def test_the_uv_map_is_one_to_one_and_denser_on_the_face(head: HeadModel) -> None:
    arrays = head.arrays
    uv = arrays.uv.astype(np.float64)[arrays.uv_faces]
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    assert area.min() > 1e-8, "no triangle is flipped or without area"
    assert uv.min() >= 0
    assert uv.max() <= 1
    # No point of a coarse grid lies strictly inside of two triangles.
    axis = (np.arange(48) + 0.5) / 48
    points = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 1, 2)
    inside = np.ones((len(points), len(uv)), bool)
    for corner in range(3):
        edge = uv[:, (corner + 1) % 3] - uv[:, corner]
        ray = points - uv[:, corner]
        inside &= edge[:, 0] * ray[..., 1] - edge[:, 1] * ray[..., 0] > 1e-9
    assert inside.sum(1).max() == 1
    corners = arrays.v_template[arrays.faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    surface, centre = 0.5 * np.linalg.norm(cross, axis=1), corners.mean(1)
    skin = np.isin(arrays.faces[:, 0], arrays.vertex_groups["skin"])
    face = skin & (centre[:, 2] > 0.04) & (np.abs(centre[:, 1] + 0.01) < 0.05)
    skull = skin & (centre[:, 2] < -0.06) & (centre[:, 1] > 0)
    assert area[face].sum() / surface[face].sum() > 2 * area[skull].sum() / surface[skull].sum()


def test_nearly_every_edge_lies_inside_a_chart(head: HeadModel) -> None:
    arrays = head.arrays
    owner: dict[tuple[int, int], int] = {}
    shared = 0
    for index, (a, b, c) in enumerate(arrays.uv_faces.tolist()):
        for edge in ((a, b), (b, c), (c, a)):
            assert edge not in owner, "neighbours run along their edge in opposite directions"
            owner[edge] = index
            shared += edge[::-1] in owner
    assert shared > 1.4 * len(arrays.uv_faces)


def test_landmarks_are_symmetric_and_on_the_right_parts(head: HeadModel) -> None:
    marks, arrays = facemesh_landmarks(), head.arrays
    assert marks.facemesh_index.tolist() == list(range(478))
    corners = arrays.faces[marks.triangle]
    places = np.einsum("lk,lkc->lc", marks.barycentric, arrays.v_template[corners])
    np.testing.assert_allclose(marks.barycentric.sum(1), 1, atol=1e-6)
    assert marks.barycentric.min() >= 0
    mirrored = places[marks.mirror] * [-1, 1, 1]
    assert np.abs(places - mirrored).max() < 0.5 * MM
    assert marks.mirror[33] == 263, "outer corners of the eyes"
    for index, part in ((468, "right_eye"), (473, "left_eye"), (4, "skin"), (152, "skin")):
        assert np.isin(corners[index], arrays.vertex_groups[part]).all(), index
    height = dict(zip(("brow", "eye", "nose", "lip", "chin"), places[[105, 33, 4, 13, 152], 1]))
    assert list(height) == sorted(height, key=lambda name: -height[name])
    assert places[33, 0] < 0 < places[263, 0], "FaceMesh's 263 is the subject's left"
    jaw = np.einsum("lk,lk->l", marks.barycentric, arrays.skinning_weights[corners, 2])
    assert (jaw[[13, 82, 312, 0]] < 0.5).all(), "points of the upper lip stay"
    assert (jaw[[14, 87, 317, 17, 152]] > 0.5).all(), "points of the lower lip follow the jaw"
    assert len(set(SPARSE_51)) == 51
    assert set(SPARSE_51) <= set(marks.facemesh_index.tolist())
