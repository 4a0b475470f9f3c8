import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.face.detector import face_height_px
from rgbavatar_ns.tracking.face.iris import FoundIrises
from rgbavatar_ns.tracking.fit.fit import fit_clip, key_frame_positions
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.verify.report import fit_quality

from .acting import ACTIVE, CAMERA, acted, degrees_apart, observed, skulls


def test_known_performance_is_recovered_from_its_own_landmarks(head: HeadModel) -> None:
    tracker, theta, identity, noisy = acted(head, 16, key_frames=6)
    noisy += np.random.default_rng(0).normal(size=noisy.shape) * 0.3
    fit = tracker.fit(noisy, [False] + [True] * 15, 320, 240)
    found = tracker.thetas(fit)
    layout = head.layout

    assert degrees_apart(skulls(tracker, found), skulls(tracker, theta)).mean() < 1.5
    for column in (layout.slice("jaw").start, layout.slice("left_eye").start + 1):
        assert np.corrcoef(found[:, column], theta[:, column])[0, 1] > 0.9
    names, first = list(head.arrays.expression_names), layout.slice("expression").start
    active = [first + names.index(name) for name in ACTIVE]
    assert np.corrcoef(found[:, active].ravel(), theta[:, active].ravel())[0, 1] > 0.8

    skin = head.arrays.v_template[:, 2] > 0.02
    with torch.no_grad():
        true = head(torch.from_numpy(theta), torch.from_numpy(identity)).numpy()[:, skin]
        ours = head(torch.from_numpy(found), torch.from_numpy(fit.subject.identity)).numpy()
    shift = CAMERA.distance_m - fit.subject.camera.distance_m
    ours = ours[:, skin] + np.array([0, 0, shift])
    away = np.linalg.norm((ours - true)[..., :2], axis=-1)
    assert away.mean() < 0.002, "metres across the image, face"

    bare_px = tracker.fitted_px(fit, with_offsets=False)
    quality = fit_quality(tracker, fit, bare_px, noisy, FoundIrises.unseen(noisy))
    assert quality["reprojection_error_share"] < 0.01
    assert quality["mouth_opening_correlation"] > 0.95
    assert quality["eyelid_opening_correlation"] > 0.95
    truly_m = np.linalg.norm(true.mean(1) - CAMERA.eye_m, axis=1)
    assert quality["camera_distance_m"] == pytest.approx(np.median(truly_m), rel=0.03)
    assert tracker.rejected(fit, noisy) == []
    bounds = tracker.cost.parameters
    assert ((bounds.lower <= fit.values) & (fit.values <= bounds.upper)).all()


@pytest.mark.parametrize("seed", [4, 5])
def test_an_error_that_all_frames_share_makes_no_deeper_face(head: HeadModel, seed: int) -> None:
    """A millimetre across the picture is at most one of depth, before an average, still head."""
    random = np.random.default_rng(seed)
    tracker, theta, identity, _ = acted(head, 12, key_frames=12)
    average = np.zeros_like(identity)
    points = observed(tracker, np.zeros_like(theta), average)
    one_mm = 0.001 * CAMERA.focal_px / CAMERA.distance_m
    points += one_mm * random.normal(size=points.shape[1:])
    # Frames that do not differ are no key frames.
    points += 0.05 * one_mm * random.normal(size=points.shape)
    found = tracker.fit_subject(points, 320, 240).identity
    rest = torch.zeros(head.layout.size, dtype=torch.float64)
    with torch.no_grad():
        ours, true = (head(rest, torch.from_numpy(person)).numpy() for person in (found, average))
    deeper = (ours - true)[head.arrays.v_template[:, 2] > 0.02, 2]
    assert deeper.std() < 0.001


def test_a_camera_that_nobody_names_is_as_far_off_as_faces_look(head: HeadModel) -> None:
    """Whatever the picture's size, and however much of it the face fills; but no lens is wider than
    .7 longer sides."""
    tracker, _, _, points = acted(head, 2, key_frames=1)
    unknown = SubjectTracker(head, replace(tracker.config, focal_px=None))
    for width, height in ((320, 240), (240, 320), (800, 600)):
        camera = unknown.fit_subject(points, width, height).camera
        assert camera.focal_px == pytest.approx(5.8 * np.median(face_height_px(points)))
        assert camera.distance_m == pytest.approx(1.1, abs=0.05)
    assert unknown.fit_subject(0.5 * points, 320, 240).camera.focal_px == pytest.approx(
        0.5 * unknown.fit_subject(points, 320, 240).camera.focal_px
    )
    far = unknown.fit_subject(0.1 * points, 320, 240).camera
    assert far.focal_px == pytest.approx(0.7 * 320)
    assert far.distance_m > 1.2
    assert tracker.fit_subject(points, 320, 240).camera.focal_px == CAMERA.focal_px


def test_the_same_landmarks_give_the_same_fit_and_a_gap_is_not_bridged(head: HeadModel) -> None:
    tracker, _, _, points = acted(head, 6, key_frames=3, identity_components=5)
    follows = [False, True, True, False, True, True]
    again = SubjectTracker(head, tracker.config)
    runs = [each.fit(points, follows, 320, 240) for each in (tracker, again)]
    np.testing.assert_array_equal(runs[0].values, runs[1].values)
    # What comes after the gap changes nothing before it.
    subject, targets = runs[0].subject, tracker.targets(points)
    rest = (1.0, lambda *_: True)
    whole = fit_clip(tracker.cost, subject, targets, follows, *rest).values
    alone = fit_clip(tracker.cost, subject, targets[:3], follows[:3], *rest).values
    np.testing.assert_array_equal(whole[:3], alone)


def test_smoothing_lowers_jitter_without_lag(head: HeadModel) -> None:
    tracker, theta, _, noisy = acted(head, 12, key_frames=3, identity_components=3)
    noisy += np.random.default_rng(3).normal(size=noisy.shape)
    follows = [False] + [True] * 11
    smooth = tracker.fit(noisy, follows, 320, 240)
    unsmoothed = SubjectTracker(head, replace(tracker.config, temporal_weight=0.0))
    rough = unsmoothed.fit(noisy, follows, 320, 240)
    yaw = tracker.cost.parameters.columns.tolist().index(head.layout.slice("rotation").start + 1)
    true = theta[:, head.layout.slice("rotation").start + 1]

    def jitter(values: np.ndarray) -> float:
        return float(np.square(np.diff(values, 2)).mean())

    assert jitter(smooth.values[:, yaw]) < jitter(rough.values[:, yaw])
    found = smooth.values[:, yaw]
    shifted = [np.abs(np.roll(found, -lag) - true)[2:-2].std() for lag in (-1, 0, 1)]
    assert np.argmin(shifted) == 1


def test_landmarks_that_no_head_explains_are_rejected(head: HeadModel) -> None:
    tracker, _, _, broken = acted(head, 4, key_frames=3, identity_components=3)
    fit = tracker.fit(broken, [False, True, True, True], 320, 240)
    random = np.random.default_rng(1)
    broken[2, 30:] += random.normal(size=(448, 2)) * 15
    assert tracker.rejected(fit, broken) == [2]


def test_frames_that_no_head_explains_neither_make_the_person_nor_move_their_neighbours(
    head: HeadModel,
) -> None:
    """A hand before the chin, as FaceMesh draws it together; and a face that is none, rolled."""
    tracker, theta, _, points = acted(head, 20, key_frames=8)
    points += np.random.default_rng(0).normal(size=points.shape) * 0.3
    follows, spoiled = [False] + [True] * 19, points.copy()
    for position in (6, 7):
        middle = points[position].mean(0)
        low = points[position, :, 1] > middle[1]
        spoiled[position, low, 1] = middle[1] + 0.3 * (points[position, low, 1] - middle[1])
        spoiled[position, low, 0] += 8
    middle = points[13].mean(0)
    spoiled[13] = (points[13] - middle) @ [[0, 1], [-1, 0]] + middle
    spoiled[13] += np.random.default_rng(1).normal(size=points[13].shape) * 9
    keys = tracker.key_positions(spoiled, 320, 240)
    assert len(keys) == 8
    assert not {6, 7, 13} & set(keys)
    whole = tracker.fit(points, follows, 320, 240)
    among = SubjectTracker(head, tracker.config)
    fit = among.fit(spoiled, follows, 320, 240)
    assert among.rejected(fit, spoiled) == [6, 7, 13]
    kept = [k for k in range(20) if k not in (6, 7, 13)]
    off = [
        degrees_apart(skulls(who, who.thetas(found)[kept]), skulls(tracker, theta[kept]))
        for who, found in ((tracker, whole), (among, fit))
    ]
    assert off[1].max() < off[0].max() + 1


def test_key_frames_differ_and_are_the_same_each_time() -> None:
    random = np.random.default_rng(2)
    still, moved = random.normal(size=(478, 2)), random.normal(size=(478, 2))
    clip = np.stack([still, still, moved * 3, still + 5, still])
    chosen = key_frame_positions(clip, 2)
    assert len(chosen) == 2
    assert 2 in chosen, "a translation alone is no new shape"
    assert key_frame_positions(clip, 99) == key_frame_positions(clip, 5)


def test_key_frames_of_a_long_film_are_those_worked_out_at_once_in_little_memory() -> None:
    random = np.random.default_rng(3)
    clip = random.normal(size=(1500, 478, 2)) + 40 * random.normal(size=(1500, 1, 2))
    among = np.flatnonzero(random.random(1500) < 0.8)
    shapes = (clip - clip.mean(1, keepdims=True)).reshape(1500, -1)[among]
    expected = [int(((shapes - np.median(shapes, axis=0)) ** 2).sum(1).argmin())]
    while len(expected) < 12:
        apart = ((shapes[:, None] - shapes[expected]) ** 2).sum(-1)
        expected.append(int(apart.min(1).argmax()))
    tracemalloc.start()
    chosen = key_frame_positions(clip, 12, among)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert chosen == sorted(among[expected].tolist())
    assert most < clip.nbytes


def test_the_mesh_is_of_the_person_that_is_asked_for(head: HeadModel) -> None:
    tracker, _, _, points = acted(head, 3, key_frames=3, identity_components=3)
    first = tracker.fit(points, [False, True, True], 320, 240)
    other = replace(first, subject=replace(first.subject, identity=first.subject.identity + 1))
    found = [tracker.vertices_px(fit, 0) for fit in (first, other, first)]
    np.testing.assert_array_equal(found[0], found[2])
    alone = SubjectTracker(head, tracker.config).vertices_px(other, 0)
    np.testing.assert_array_equal(found[1], alone)
    assert np.abs(found[1] - found[0]).max() > 1, "another person"
