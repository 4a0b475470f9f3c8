"""Eyes move together, lids hide them, and the report tells where the fitted head looks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.detector import (
    EYE_CORNERS,
    IRIS_CENTERS,
    LID_PAIRS,
    eye_widths_px,
    irises_seen,
)
from rgbavatar_ns.tracking.face.iris import FoundIrises
from rgbavatar_ns.tracking.fit.fit import ClipFit, SubjectFit, fit_frame
from rgbavatar_ns.tracking.fit.irises import iris_places
from rgbavatar_ns.tracking.fit.parameters import GAZE_BOUNDS_RAD
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.verify.gaze import gaze_quality, iris_distances
from tests.tracking.acting import CAMERA, observed, performance

EYES = ("right_eye", "left_eye")


@pytest.fixture(scope="module")
def tracker(head: HeadModel) -> SubjectTracker:
    return SubjectTracker(head, TrackConfig())


def _eyes(lid_gap: float) -> np.ndarray:
    """Landmarks [478, 2] of eyes 40 pixels wide, lids so many eye widths apart."""
    points = np.random.default_rng(0).uniform(0, 200, (478, 2))
    for (first, second), left in zip(EYE_CORNERS, (20.0, 120.0)):
        points[[first, second]] = (left, 50.0), (left + 40.0, 50.0)
    for upper, lower in LID_PAIRS:
        points[[upper, lower]] = (60.0, 50.0 - 20 * lid_gap), (60.0, 50.0 + 20 * lid_gap)
    return points


def test_an_iris_is_believed_where_its_own_lids_are_open() -> None:
    wide, narrow, shut = _eyes(0.3), _eyes(0.15), _eyes(0.05)
    seen = irises_seen(np.stack([wide, narrow, shut]))
    np.testing.assert_allclose(seen, [[1, 1], [0.5, 0.5], [0, 0]], atol=1e-12)
    wink = wide.copy()
    for upper, lower in LID_PAIRS[3:]:
        wink[upper] = wink[lower]
    np.testing.assert_allclose(irises_seen(wink), [1, 0], atol=1e-12)


def _looking(tracker: SubjectTracker, eyes_rad: tuple[float, float]) -> tuple[np.ndarray, ...]:
    """Theta of a head whose eyes have this pitch and yaw, and its landmarks [478, 2]."""
    layout = tracker.head.layout
    theta = np.zeros(layout.size)
    for name in EYES:
        theta[layout.slice(name)] = (*eyes_rad, 0.0)
    return theta, observed(tracker, theta[None], np.zeros(tracker.head.num_identity))[0]


def _fitted_gaze(tracker: SubjectTracker, points: np.ndarray, seen: float = 1.0) -> np.ndarray:
    """Degrees: pitch and yaw of the right eye, of the left one."""
    target = tracker.targets(points[None])[0]
    counts = target.seen.copy()
    counts[np.flatnonzero(np.isin(tracker.facemesh_index, IRIS_CENTERS))] = seen
    target = replace(target, seen=counts)
    start = np.zeros(len(tracker.cost.parameters.columns))
    theta = tracker.cost.theta(fit_frame(tracker.cost, CAMERA, target, start, None, 0.0, (14, 6)))
    return np.degrees([theta[tracker.head.layout.slice(name)][:2] for name in EYES])


def test_eyes_turn_together_whatever_each_iris_says(tracker: SubjectTracker) -> None:
    for pitch in (-0.1, 0.1):
        _, points = _looking(tracker, (pitch, 0.0))
        common = _fitted_gaze(tracker, points)[:, 0]
        share = common / np.degrees(pitch)
        assert 0.25 < share.min() <= share.max() < 1.1, "both look up or down"
        points[list(IRIS_CENTERS), 1] += np.array([1, -1]) * 0.03 * eye_widths_px(points).mean()
        torn = _fitted_gaze(tracker, points)[:, 0]
        assert abs(torn[0] - torn[1]) < 1, "irises .06 eye widths apart are no gaze"
        np.testing.assert_allclose(torn.mean(), common.mean(), atol=1)


def test_a_glance_is_found_and_hardly_shrunk_sideways(tracker: SubjectTracker) -> None:
    for yaw in (-0.25, 0.25):
        _, points = _looking(tracker, (0.0, yaw))
        found = _fitted_gaze(tracker, points)[:, 1]
        np.testing.assert_allclose(found, np.degrees(yaw), atol=2)
        assert 0 < found[0] - found[1] < 2.5, "the right eye turns left of the left one: they meet"


def test_what_lids_hide_says_nothing(tracker: SubjectTracker) -> None:
    _, points = _looking(tracker, (0.0, 0.0))
    strayed = points.copy()
    strayed[list(IRIS_CENTERS), 0] += 0.2 * eye_widths_px(points).mean()
    assert abs(_fitted_gaze(tracker, strayed)[:, 1]).min() > 5
    np.testing.assert_allclose(
        _fitted_gaze(tracker, strayed, seen=0.0), _fitted_gaze(tracker, points, seen=0.0), atol=1e-9
    )


def test_irises_lie_ahead_of_the_eyes_and_turn_with_them(head: HeadModel) -> None:
    corners, places = iris_places(head.arrays)
    at_rest = np.einsum("nk,nkx->nx", places, head.arrays.v_template[corners])
    joints = head.joints().numpy()[[4, 3]]
    ahead = at_rest - joints
    np.testing.assert_allclose(ahead[:, :2], 0, atol=1e-6)
    assert (ahead[:, 2] > 0.01).all()
    tracker = SubjectTracker(head, TrackConfig())
    theta, _ = _looking(tracker, (0.1, -0.3))
    turned = joints + ahead @ Rotation.from_rotvec([0.1, -0.3, 0]).as_matrix().T
    found = tracker.irises_px(_clip(tracker, theta[None], np.zeros(head.num_identity)))
    np.testing.assert_allclose(found[0], CAMERA.project(turned), atol=1e-3)


def test_a_head_without_eyeballs_is_refused(head: HeadModel) -> None:
    arrays = head.arrays
    without = np.array(arrays.skinning_weights)
    without[:, 3:] = 0
    bare = replace(arrays, skinning_weights=without)
    with pytest.raises(UserError, match="no eyeball"):
        iris_places(bare)


def _clip(tracker: SubjectTracker, theta: np.ndarray, identity: np.ndarray) -> ClipFit:
    values = theta[:, tracker.cost.parameters.columns]
    return ClipFit(SubjectFit(identity, CAMERA, values[:1]), values)


def test_iris_errors_are_in_eye_widths_and_bounds_are_counted(head: HeadModel) -> None:
    tracker = SubjectTracker(head, TrackConfig())
    theta, identity = performance(head, 8)
    layout = head.layout
    theta[2, layout.slice("left_eye").start] = GAZE_BOUNDS_RAD[1]
    theta[5, layout.slice("right_eye").start + 1] = GAZE_BOUNDS_RAD[0]
    fit = _clip(tracker, theta, identity)
    points = np.repeat(_eyes(0.3)[None], 8, axis=0)
    sigma = np.full((8, 2, 2), 0.02)
    sigma[6:, 0] = np.inf
    found = FoundIrises(tracker.irises_px(fit) + np.array([0, 40 * 0.07]), sigma)
    quality = gaze_quality(tracker, fit, points, found)
    assert quality["irises_found_share"] == pytest.approx(14 / 16)
    assert quality["iris_error_eye_widths"] == pytest.approx(0.07)
    assert quality["worst_iris_error_eye_widths"] == pytest.approx(0.07)
    assert quality["gaze_at_bound_share"] == pytest.approx(2 / 8)
    unseen = FoundIrises.unseen(points)
    assert np.isnan(iris_distances(tracker.irises_px(fit), points, unseen)).all()
    assert gaze_quality(tracker, fit, points, unseen)["iris_error_eye_widths"] is None


def test_irises_found_in_the_picture_tell_the_gaze_where_facemeshs_lag(
    tracker: SubjectTracker,
) -> None:
    for pitch, yaw in ((-0.15, 0.0), (0.15, 0.2), (0.0, -0.3)):
        theta, points = _looking(tracker, (pitch, yaw))
        _, ahead = _looking(tracker, (0.0, 0.0))
        points[list(IRIS_CENTERS)] = ahead[list(IRIS_CENTERS)]  # they do not follow at all
        true_px = tracker.irises_px(
            _clip(tracker, theta[None], np.zeros(tracker.head.num_identity))
        )
        found = FoundIrises(true_px, np.full((1, 2, 2), 0.01))
        (target,) = tracker.targets(points[None], found)
        start = np.zeros(len(tracker.cost.parameters.columns))
        values = fit_frame(tracker.cost, CAMERA, target, start, None, 0.0, (14, 6))
        gaze = tracker.gaze(ClipFit(SubjectFit(np.zeros(0), CAMERA, values[None]), values[None]))
        found_degrees = np.degrees(gaze.reshape(2, 2).mean(0))
        np.testing.assert_allclose(found_degrees, np.degrees([pitch, yaw]), atol=1.5)


def test_a_found_iris_is_weighed_by_its_own_error_along_each_axis(tracker: SubjectTracker) -> None:
    _, points = _looking(tracker, (0.0, 0.0))
    sigma = np.array([[[0.01, 0.03], [np.inf, np.inf]]])
    centers = points[None, list(IRIS_CENTERS)]
    (target,) = tracker.targets(points[None], FoundIrises(centers, sigma))
    width, height = eye_widths_px(points)[0], target.face_height_px
    np.testing.assert_allclose(target.own_share[-2] * height, sigma[0, 0] * width)
    guessed = [list(tracker.facemesh_index).index(iris) for iris in IRIS_CENTERS]
    np.testing.assert_array_equal(target.seen[guessed], [0, 1], "found: FaceMesh's is not asked")
    np.testing.assert_array_equal(target.seen[-2:], [1, 0])
