"""Where the mouth is: what closed lips hide, an opened jaw shows."""

import numpy as np
import pytest
import torch
from embreex.rtcore import EmbreeDevice

from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays, HeadModel
from rgbavatar_ns.head.landmarks import facemesh_landmarks
from rgbavatar_ns.head.mouth import Mouth
from rgbavatar_ns.synthetic.renderer.raycast import RayScene
from tests.avatar.small_head import small_head_arrays

_BEFORE_M = np.array([0.0, -0.03, 0.6], np.float32)
"""An eye in front of the lips."""


def seen_from_before(head: HeadModel, jaw_rad: float, vertices: np.ndarray) -> np.ndarray:
    """Which vertices an eye before the face sees, by rays that Embree casts."""
    theta = torch.zeros(head.layout.size)
    theta[head.layout.slice("jaw").start] = jaw_rad
    places = head(theta).numpy()
    faces = head.faces.numpy()
    ways = (places[vertices] - _BEFORE_M).astype(np.float32)
    hits = RayScene(EmbreeDevice(), places, faces).cast(np.tile(_BEFORE_M, (len(ways), 1)), ways)
    return (hits.triangle >= 0) & (faces[hits.triangle] == vertices[:, None]).any(1)


@pytest.mark.parametrize("name", [HeadArrays.embedded().name, EMBEDDED_BUST])
def test_closed_lips_hide_what_an_opened_jaw_shows(name):
    head = HeadModel.embedded(name=name)
    mouth = Mouth.of(head.arrays)
    assert mouth is not None
    for part in (mouth.cavity, mouth.teeth, mouth.tongue):
        hidden, shown = (seen_from_before(head, jaw_rad, part).sum() for jaw_rad in (0.0, 0.4))
        assert hidden <= 0.02 * len(part)
        assert hidden + 3 < shown < len(part) / 2


def test_nothing_of_the_face_is_in_it():
    arrays = HeadArrays.embedded()
    mouth, marks = Mouth.of(arrays), facemesh_landmarks()
    assert mouth is not None
    inside = np.concatenate([mouth.cavity, mouth.teeth, mouth.tongue])
    assert len(np.unique(inside)) == len(inside)
    assert not np.isin(arrays.faces[marks.triangle], inside).all(1).any()
    skin = np.setdiff1d(arrays.vertices_of(["skin"]), mouth.cavity)
    assert arrays.v_template[mouth.cavity, 2].max() < arrays.v_template[skin, 2].max() - 0.005


def test_the_rim_lies_between_the_lips_and_is_as_wide_as_they():
    arrays = HeadArrays.embedded()
    mouth = Mouth.of(arrays)
    assert mouth is not None
    corners = arrays.v_template[mouth.rim_vertices]
    rim_m = (corners * mouth.rim_weights[..., None]).sum(1)
    wide, high, deep = np.ptp(rim_m, axis=0)
    assert 0.035 < wide < 0.055
    assert high < 0.006
    assert deep < 0.02
    # Once around: the steps from point to point add up to twice the width, bent.
    steps = np.linalg.norm(rim_m - np.roll(rim_m, 1, axis=0), axis=1)
    assert 2 * wide < steps.sum() < 3 * wide
    assert steps.max() < 0.2 * wide


def test_a_head_whose_lips_nobody_has_pointed_out_has_none():
    assert Mouth.of(small_head_arrays()) is None
