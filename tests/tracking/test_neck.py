"""Why the neck joint stays at 0: a face's landmarks are the same whichever joint turns the head."""

import numpy as np
import pytest
import torch

from rgbavatar_ns.head import HeadArrays, HeadModel, facemesh_landmarks
from rgbavatar_ns.head.rotations import axis_angle_to_matrix

TURNS = {"pitch": (0.26, 0.0, 0.0), "yaw": (0.0, 0.26, 0.0), "roll": (0.0, 0.0, 0.26)}
"""15 degrees about each axis."""


def turned_by_either_joint(turn: tuple[float, float, float]) -> np.ndarray:
    """Vertices [2, V, 3]: the whole head turns, or the neck alone, the skull in one place."""
    head = HeadModel.embedded(dtype=torch.float64)
    layout, angle = head.layout, torch.tensor(turn, dtype=torch.float64)
    root, neck = head.joints()[:2]
    apart = axis_angle_to_matrix(angle) @ (neck - root) - (neck - root)
    whole = layout.join({"rotation": angle})
    alone = layout.join({"neck": angle, "translation": apart})
    return head(torch.stack([whole, alone])).numpy()


@pytest.mark.parametrize("axis", TURNS)
def test_landmarks_do_not_tell_the_necks_turn_from_the_whole_heads(axis: str) -> None:
    arrays, marks = HeadArrays.embedded(), facemesh_landmarks()
    vertices = turned_by_either_joint(TURNS[axis])
    places = np.einsum("lk,plkx->plx", marks.barycentric, vertices[:, arrays.faces[marks.triangle]])
    away_mm = 1e3 * np.linalg.norm(places[0] - places[1], axis=1)
    assert away_mm.max() < 0.3
    assert np.median(away_mm) < 1e-3
