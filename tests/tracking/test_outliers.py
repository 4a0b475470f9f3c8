from collections.abc import Callable

import numpy as np
import pytest

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.detector import face_height_px
from rgbavatar_ns.tracking.fit.fit import fit_frame
from rgbavatar_ns.tracking.fit.landmark_cost import Target
from rgbavatar_ns.tracking.fit.subject import SubjectTracker

from .acting import CAMERA, degrees_apart, skulls

Spoil = Callable[[np.ndarray, float, np.random.Generator], np.ndarray]


def _hand_over_mouth(points: np.ndarray, face_px: float, random: np.random.Generator) -> np.ndarray:
    """The points of the lower face slip onto a hand: to one side and apart."""
    below = points[:, 1] > np.quantile(points[:, 1], 0.7)
    apart = 0.05 * random.normal(size=(below.sum(), 2))
    spoiled = points.copy()
    spoiled[below] += (np.array([0.14, -0.06]) + apart) * face_px
    return spoiled


def _single_slips(points: np.ndarray, face_px: float, random: np.random.Generator) -> np.ndarray:
    """Every eighth point is anywhere on the face, to one side of where it should be."""
    spoiled = points.copy()
    spoiled[::8] += np.abs(random.normal(size=(len(points[::8]), 2))) * 0.3 * face_px
    return spoiled


@pytest.mark.parametrize("spoil", [_hand_over_mouth, _single_slips])
@pytest.mark.parametrize("seed", range(2))
def test_a_pose_stays_right_when_landmarks_go_wrong(
    head: HeadModel, spoil: Spoil, seed: int
) -> None:
    tracker = SubjectTracker(head, TrackConfig())
    random = np.random.default_rng(seed)
    layout = tracker.head.layout
    theta = np.zeros(layout.size)
    theta[layout.slice("rotation")] = random.uniform(-0.25, 0.25, 3)
    theta[layout.slice("translation")] = random.uniform(-0.02, 0.02, 3)
    identity = np.zeros(tracker.head.num_identity)
    points = CAMERA.project(tracker.cost.head.points(theta, identity, CAMERA.eye_m))
    whole = np.zeros((478, 2))
    whole[tracker.facemesh_index] = points[: len(tracker.facemesh_index)]
    face_px = float(face_height_px(whole[None])[0])
    start = np.zeros(len(tracker.cost.parameters.columns))
    own_share = np.repeat(tracker.cost.noise.own_share[:, None], 2, axis=1)
    spoilt = spoil(points, face_px, random)
    target = Target(spoilt, own_share, face_px, np.eye(2), np.ones(len(points)))
    values = fit_frame(tracker.cost, CAMERA, target, start, None, 0.0, (8, 4))
    found = tracker.cost.theta(values)

    (angle,) = degrees_apart(skulls(tracker, found[None]), skulls(tracker, theta[None]))
    assert angle < 1.5
    shift = found[layout.slice("translation")] - theta[layout.slice("translation")]
    assert np.linalg.norm(shift[:2]) < 0.01 * CAMERA.distance_m
