"""The frame's cost: what is common to a detector's errors, robustness, priors, derivatives."""

from dataclasses import replace

import numpy as np
import pytest

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.landmarks import LandmarkNoise, facemesh_noise
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.landmark_cost import FrameCost, FrameTerms, Target
from rgbavatar_ns.tracking.fit.parameters import FitParameters
from rgbavatar_ns.tracking.fit.subject import SubjectTracker

from .acting import CAMERA

FACE_PX = 150.0


@pytest.fixture(scope="module")
def tracker(head: HeadModel) -> SubjectTracker:
    return SubjectTracker(head, TrackConfig())


def _with_noise(cost: FrameCost, seed: int, modes: int = 3) -> FrameCost:
    random, count = np.random.default_rng(seed), cost.head.num_landmarks
    noise = LandmarkNoise(
        0.004 * random.normal(size=(count, 2, modes)), random.uniform(0.004, 0.01, count)
    )
    return replace(cost, noise=noise)


def _pose(tracker: SubjectTracker, seed: int) -> np.ndarray:
    random, bounds = np.random.default_rng(seed), tracker.cost.parameters
    values = random.uniform(0.2, 0.6, len(bounds.columns)) * np.minimum(bounds.upper, 0.3)
    return tracker.cost.theta(values)


def _seen(
    cost: FrameCost, theta: np.ndarray, away_share: np.ndarray, redescending: bool = False
) -> FrameTerms:
    """The head's points, each as many shares of the face's height away."""
    points = CAMERA.project(cost.head.points(theta, np.zeros(30), CAMERA.eye_m))
    own_share = np.repeat(cost.noise.own_share[:, None], 2, axis=1)
    seen_px = points - away_share * FACE_PX
    target = Target(seen_px, own_share, FACE_PX, np.eye(2), np.ones(len(points)))
    return FrameTerms(target, CAMERA, redescending)


@pytest.mark.parametrize("seed", range(3))
def test_small_errors_cost_what_their_covariance_says(tracker: SubjectTracker, seed: int) -> None:
    cost, theta = _with_noise(tracker.cost, seed), _pose(tracker, seed)
    away = 0.002 * np.random.default_rng(seed).normal(size=(cost.head.num_landmarks, 2))
    modes = cost.noise.modes.reshape(-1, 3)
    covariance = np.diag(np.repeat(cost.noise.own_share**2, 2)) + modes @ modes.T
    expected = 0.5 * away.reshape(-1) @ np.linalg.solve(covariance, away.reshape(-1))
    found = cost.data_at(theta, np.zeros(30), _seen(cost, theta, away)).cost
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_what_all_points_err_in_common_costs_little_and_alone_much(tracker: SubjectTracker) -> None:
    cost, theta = _with_noise(tracker.cost, 0), _pose(tracker, 0)
    mode = cost.noise.modes[..., 0]
    others = mode[np.random.default_rng(1).permutation(len(mode))]
    common, mixed = (
        cost.data_at(theta, np.zeros(30), _seen(cost, theta, away)).cost for away in (mode, others)
    )
    assert common < 0.55, "one standard deviation of one number"
    assert mixed > 20 * common


@pytest.mark.parametrize("redescending", [False, True])
def test_the_gradient_is_the_costs_derivative(tracker: SubjectTracker, redescending: bool) -> None:
    cost, theta = _with_noise(tracker.cost, 2), _pose(tracker, 2)
    random = np.random.default_rng(3)
    away = 0.006 * random.normal(size=(cost.head.num_landmarks, 2))
    frame = _seen(cost, theta, away, redescending)
    found = cost.data_at(theta, np.zeros(30), frame).model()

    def value(theta: np.ndarray) -> float:
        return cost.data_at(theta, np.zeros(30), frame).cost

    translation = set(range(*cost.head.layout.slice("translation").indices(len(theta))))
    for place, column in enumerate(cost.parameters.columns):
        if int(column) in translation:
            continue  # there the direction to the camera counts as fixed
        step = np.zeros(len(theta))
        step[column] = 1e-5
        slope = (value(theta + step) - value(theta - step)) / 2e-5
        # The modes' amounts are found by a few reweightings: nearly the best ones.
        size = np.sqrt(found.hessian[place, place])
        assert abs(found.gradient[place] - slope) < 0.05 * size + 0.02 * abs(slope), int(column)


def test_a_picture_turned_by_a_quarter_costs_the_same(tracker: SubjectTracker) -> None:
    away = 0.01 * np.random.default_rng(5).normal(size=(478, 2))
    camera = StillCamera(700.0, (120.0, 120.0), 0.8)
    head, theta = tracker.cost.head, np.zeros(tracker.head.layout.size)
    seen = np.zeros((478, 2))
    points_px = camera.project(head.points(theta, np.zeros(30), camera.eye_m))
    seen[tracker.facemesh_index] = points_px[: len(tracker.facemesh_index)]
    seen += FACE_PX * away
    turned = np.stack([240 - seen[:, 1], seen[:, 0]], 1)
    lying = theta.copy()
    rotation, shift = (head.layout.slice(name) for name in ("rotation", "translation"))
    lying[rotation.start + 2] = -np.pi / 2
    # The head turns about its root joint; the picture about its middle.
    moved = head.points(lying, np.zeros(30), camera.eye_m)
    upright = head.points(theta, np.zeros(30), camera.eye_m)
    wanted = np.stack([upright[:, 1], -upright[:, 0], upright[:, 2]], 1)
    lying[shift] += (wanted - moved).mean(0)
    costs = [
        tracker.cost.data_at(
            pose, np.zeros(30), FrameTerms(tracker.targets(points[None])[0], camera)
        ).cost
        for pose, points in ((theta, seen), (lying, turned))
    ]
    np.testing.assert_allclose(costs[0], costs[1], rtol=0.02)  # the view's slides change a little


def test_ties_draw_entries_together_and_leave_their_mean_to_the_widths() -> None:
    width = np.array([0.5, 0.5, 1.0])
    free = np.zeros(3)
    parameters = FitParameters(
        *(np.array([7, 9, 11]), free, free, width, width),
        *(np.array([[7, 9]]), np.array([0.3]), np.array([0.1])),
    )
    precision = parameters.prior_precision()
    np.testing.assert_allclose(precision @ [1.0, 1.0, 0.0], [4.0, 4.0, 0.0])
    np.testing.assert_allclose(precision @ [1.0, -1.0, 0.0], [204.0, -204.0, 0.0])
    assert precision[2, 2] == 1.0
    # The first is drawn .3 above the second, against widths of .5 around 0.
    best = np.linalg.solve(precision, parameters.prior_pull())
    np.testing.assert_allclose(best, [0.3 * 100 / 204, -0.3 * 100 / 204, 0.0], rtol=1e-12)


def test_both_sides_of_a_face_are_tied_and_no_side_of_the_jaw(tracker: SubjectTracker) -> None:
    names, first = tracker.head.arrays.expression_names, tracker.head.layout.slice("expression")
    pairs = tracker.cost.parameters.ties.tolist()
    layout = tracker.head.layout
    left, right = (layout.slice(name).start for name in ("left_eye", "right_eye"))
    assert pairs[:2] == [[left, right], [left + 1, right + 1]], "eyes move together"
    assert tracker.cost.parameters.tie_mean[1] < 0, "the left eye turns to its right, to the nose"
    assert not np.delete(tracker.cost.parameters.tie_mean, 1).any()
    tied = {frozenset(names[column - first.start] for column in pair) for pair in pairs[2:]}
    assert frozenset(("mouthSmileLeft", "mouthSmileRight")) in tied
    assert frozenset(("cheekSquintLeft", "mouthSmileLeft")) in tied
    assert frozenset(("browInnerUp", "browOuterUpRight")) in tied
    assert frozenset(("jawLeft", "jawRight")) not in tied
    assert frozenset(("mouthLeft", "mouthRight")) not in tied
    assert all(len(pair) == 2 for pair in tied)


def test_facemeshs_noise_is_one_for_each_landmark_and_moderate() -> None:
    noise = facemesh_noise()
    assert noise.modes.shape[:2] == (478, 2)
    assert noise.own_share.shape == (478,)
    assert np.isfinite(noise.modes).all()
    assert (noise.own_share > 0).all()
    assert np.sqrt((noise.modes**2).sum((1, 2))).max() < 0.1, "shares of the face's height"
