"""ARKit's coefficients as theta: by name, on joints, and on a head that speaks FLAME."""

import math

import numpy as np
import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays, HeadModel
from rgbavatar_ns.head.arkit import ARKIT_NAMES, arkit_coefficients, arkit_map
from rgbavatar_ns.head.landmarks import facemesh_landmarks


def _theta(arrays: HeadArrays, **named: float) -> torch.Tensor:
    return arkit_map(arrays).theta(arkit_coefficients(named).double())


def test_there_are_all_52_names_once():
    assert len(ARKIT_NAMES) == len(set(ARKIT_NAMES)) == 52
    assert set(ARKIT_NAMES) == set(HeadArrays.embedded().expression_names)


def test_an_expression_of_the_embedded_head_is_its_namesake():
    arrays = HeadArrays.embedded()
    theta = _theta(arrays, mouthSmileLeft=0.4, EyeBlinkRight=0.7)
    expected = torch.zeros(HeadModel(arrays).layout.size, dtype=torch.float64)
    expected[arrays.expression_names.index("mouthSmileLeft")] = 0.4
    expected[arrays.expression_names.index("eyeBlinkRight")] = 0.7
    torch.testing.assert_close(theta, expected, rtol=0, atol=1e-7)


def test_an_open_jaw_is_the_joint_and_moves_the_skin_as_the_sculptor_did():
    arrays = HeadArrays.embedded()
    head = HeadModel(arrays, torch.float64)
    by_joint = _theta(arrays, jawOpen=1.0)
    sculpted = torch.zeros_like(by_joint)
    sculpted[arrays.expression_names.index("jawOpen")] = 1.0
    at_rest = head(torch.zeros_like(by_joint))
    moved, wanted = head(by_joint) - at_rest, head(sculpted) - at_rest
    assert by_joint[head.layout.slice("jaw")][0] == pytest.approx(math.radians(24.4), abs=0.001)
    chin = facemesh_landmarks()
    row = int(np.flatnonzero(chin.facemesh_index == 152)[0])
    corners = arrays.faces[chin.triangle[row]].astype(np.int64)
    # The whole face alike, the chin to millimetres of its 39.
    assert (moved - wanted)[corners].norm(dim=1).max() < 0.003
    assert wanted[corners].norm(dim=1).min() > 0.03


@pytest.mark.parametrize(
    ("name", "side", "along"),
    [
        ("eyeLookOutLeft", "left_eye", [1, 0]),
        ("eyeLookInLeft", "left_eye", [-1, 0]),
        ("eyeLookOutRight", "right_eye", [-1, 0]),
        ("eyeLookInRight", "right_eye", [1, 0]),
        ("eyeLookUpLeft", "left_eye", [0, 1]),
        ("eyeLookDownRight", "right_eye", [0, -1]),
    ],
)
def test_eyes_look_where_they_are_told(name, side, along):
    """Out of the left eye's front a pupil looks to +x, the subject's left, or up, +y."""
    arrays = HeadArrays.embedded()
    head, joint = HeadModel(arrays, torch.float64), {"left_eye": 3, "right_eye": 4}[side]
    theta = _theta(arrays, **{name: 1.0})
    eye = arrays.vertex_groups[side]
    pupil = eye[arrays.v_template[eye][:, 2].argmax()]
    centre = arrays.joint_regressor[joint] @ arrays.v_template
    looks = head(theta)[pupil].numpy() - centre
    looks /= np.linalg.norm(looks)
    assert looks[:2] @ np.array(along) > math.sin(math.radians(20))


def test_coefficients_come_back_from_theta():
    arrays = HeadArrays.embedded()
    known = arkit_map(arrays)
    generator = torch.Generator().manual_seed(0)
    coefficients = torch.rand(30, 52, generator=generator, dtype=torch.float64)
    # An eye does not look to both sides.
    for one, other in (("In", "Out"), ("Up", "Down")):
        for side in ("Left", "Right"):
            looks = [ARKIT_NAMES.index(f"eyeLook{way}{side}") for way in (one, other)]
            coefficients[:15, looks[0]] = 0
            coefficients[15:, looks[1]] = 0
    back = known.coefficients(known.theta(coefficients))
    torch.testing.assert_close(back, coefficients, rtol=0, atol=1e-9)


def test_the_head_turns_on_its_shoulders_where_there_are_any():
    turn = torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64)
    nothing = torch.zeros(52, dtype=torch.float64)
    for name, field in ((HeadArrays.embedded().name, "rotation"), (EMBEDDED_BUST, "neck")):
        known = arkit_map(HeadArrays.embedded(name))
        theta = known.theta(nothing, turn)
        assert torch.equal(theta[known.layout.slice(field)], turn)
        assert int((theta != 0).sum()) == 3
        torch.testing.assert_close(known.head_rotation(theta), turn)


def test_flame_makes_the_same_faces(flame_2020):
    """What FLAME's nameless directions make of ARKit's is compared on points of the face."""
    known = arkit_map(flame_2020)
    gaze = [name.startswith("eyeLook") for name in ARKIT_NAMES]
    shown = ~np.array([name == "tongueOut" for name in ARKIT_NAMES]) & ~np.array(gaze)
    assert known.unexplained[shown].max() < 0.1
    assert np.median(known.unexplained[shown]) < 0.03
    assert known.unexplained[ARKIT_NAMES.index("tongueOut")] == 1.0
    head = HeadModel(flame_2020, torch.float64)
    embedded = HeadModel(HeadArrays.embedded(), torch.float64)
    # The made-up FLAME is the embedded head cut and renumbered: its vertices have namesakes.
    wide, near = embedded.arrays.v_template, flame_2020.v_template
    same = np.linalg.norm(wide[:, None, ::1] - near[None, :400], axis=2).argmin(0)
    assert np.linalg.norm(wide[same] - near[:400], axis=1).max() < 1e-4
    for name in ("mouthSmileLeft", "jawOpen", "eyeBlinkLeft", "browDownRight"):
        row = arkit_coefficients({name: 1.0}).double()
        moved = head(known.theta(row))[:400] - torch.from_numpy(near[:400]).double()
        own = arkit_map(embedded.arrays).theta(row)
        wanted = embedded(own)[same] - torch.from_numpy(wide[same]).double()
        assert (moved - wanted).norm(dim=1).max() < 0.0025, name


def test_what_is_no_coefficient_is_told():
    with pytest.raises(UserError, match="Did you mean mouthSmileLeft"):
        arkit_coefficients({"mouthSmilLeft": 0.3})
    with pytest.raises(UserError, match="jawOpen is nan"):
        arkit_coefficients({"jawOpen": math.nan})
    beyond = arkit_map(HeadArrays.embedded()).theta(arkit_coefficients({"browInnerUp": 7.0}))
    assert beyond.max() == 1.0
