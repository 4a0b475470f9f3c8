"""Landmarks carried to a head of other triangles, whose place on it is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, facemesh_landmarks
from rgbavatar_ns.head.landmarks import LandmarkMap, facemesh_noise, facemesh_response
from rgbavatar_ns.head.registration import register
from rgbavatar_ns.tracking.face.landmark_transfer import FittedHead, carried_noise, fitted_head
from tests.head.synthetic_head import flame_shaped_arrays

from .remeshed_head import SCALE, TURN, as_another_model, moved, remeshed

IRISES = 468


def places(head: HeadArrays, marks: LandmarkMap, vertices: np.ndarray | None = None) -> np.ndarray:
    vertices = head.v_template if vertices is None else vertices
    return np.einsum("lk,lkx->lx", marks.barycentric, vertices[head.faces[marks.triangle]])


@cache
def another() -> tuple[FittedHead, np.ndarray, np.ndarray]:
    """Another model with what was found on it, its person, and how its expressions are mixed."""
    random = np.random.default_rng(1)
    person = random.normal(0, 1, HeadArrays.embedded().num_identity)
    mix, _ = np.linalg.qr(random.normal(size=(HeadArrays.embedded().num_expressions,) * 2))
    return fitted_head(as_another_model(remeshed(), person, mix)), person, mix


@pytest.fixture(scope="module")
def flame(flame_2020: HeadArrays) -> FittedHead:
    """A FLAME without eyelid files."""
    return fitted_head(replace(flame_2020, eyelid_dirs=None))


def test_a_point_whose_place_is_less_sure_than_before_counts_less() -> None:
    marks, known = facemesh_landmarks(), facemesh_noise()
    np.testing.assert_allclose(carried_noise(marks).own_share, known.own_share)
    first = int(marks.facemesh_index[0])
    at_first = np.arange(len(marks.spread_m)) == 0
    sure = np.where(at_first, 0.0, marks.spread_m)
    unsure = np.where(at_first, 0.002 * np.sqrt(3), marks.spread_m)
    shares = [carried_noise(replace(marks, spread_m=spread)).own_share for spread in (sure, unsure)]
    np.testing.assert_allclose(shares[1][first], 2 * shares[0][first])
    np.testing.assert_allclose(np.delete(shares[1], first), np.delete(known.own_share, first))


@pytest.mark.slow
def test_landmarks_keep_their_place_on_a_head_of_other_triangles_person_size_and_tilt() -> None:
    found, person, _ = another()
    embedded, marks = HeadArrays.embedded(), facemesh_landmarks()
    shaped = embedded.v_template + embedded.shapedirs[..., : embedded.num_identity] @ person
    true = moved(places(embedded, marks, shaped))
    away_mm = 1e3 * np.linalg.norm(places(found.arrays, found.landmarks) - true, axis=1)
    skin = marks.facemesh_index < IRISES
    assert away_mm[skin].mean() < 0.3
    assert np.quantile(away_mm[skin], 0.97) < 1.0
    assert away_mm.max() < 2.0
    np.testing.assert_array_equal(found.landmarks.facemesh_index, marks.facemesh_index)


def test_landmarks_keep_their_place_to_a_tenth_of_a_millimetre_on_flames_triangles(
    flame: FittedHead,
) -> None:
    marks = facemesh_landmarks()
    away_m = places(flame.arrays, flame.landmarks) - places(HeadArrays.embedded(), marks)
    assert np.linalg.norm(away_m, axis=1).max() < 1e-4


def test_every_landmark_of_the_skin_lies_on_skin_and_the_irises_on_their_own_eyeball() -> None:
    found, _, _ = another()
    arrays, marks = found.arrays, found.landmarks
    corners = arrays.faces[marks.triangle]
    owners = [
        ("skin", range(IRISES)),
        ("right_eye", range(468, 473)),
        ("left_eye", range(473, 478)),
    ]
    for group, indices in owners:
        own = np.isin(marks.facemesh_index, list(indices))
        assert np.isin(corners[own], arrays.vertex_groups[group]).all(), group
    assert (marks.barycentric >= 0).all()
    np.testing.assert_allclose(marks.barycentric.sum(1), 1)


def test_response_to_view_jaw_and_gaze_is_turned_and_scaled_with_the_head() -> None:
    found, person, _ = another()
    own = facemesh_response()
    for name in ("jaw_open", "gaze"):
        wanted = SCALE * np.einsum("xy,ly...->lx...", TURN, getattr(own, name))
        away = getattr(found.response, name) - wanted
        # Size and tilt are found but for what may as well be the person.
        assert np.abs(away).mean() < 0.06 * np.abs(wanted).mean(), name
    # Seen from one place, the two heads are answered alike.
    towards = np.array([0.2, -0.1, 0.0])
    towards[2] = np.sqrt(1 - towards @ towards)
    answers = []
    for response, (x, y, _) in ((own, towards), (found.response, TURN @ towards)):
        answers.append(response.rest + response.view @ [x, y, x * x, y * y, x * y])
    wanted = SCALE * (answers[0] + own.identity @ person) @ TURN.T
    # What the other person at rest adds is known as well as that person is.
    assert np.abs(answers[1] - wanted).mean() < 3e-4


def test_response_to_mixed_expressions_is_the_mixture_of_responses() -> None:
    found, _, mix = another()
    wanted = SCALE * np.einsum("xy,lye->lxe", TURN, facemesh_response().expression @ mix)
    # Behind them are the eyelids, which a head of unnamed expressions gets.
    answered = found.response.expression[..., : mix.shape[1]]
    agreement = np.corrcoef(answered.ravel(), wanted.ravel())[0, 1]
    assert agreement > 0.9


def test_flame_without_eyelid_files_gets_eyelids_that_close(flame: FittedHead) -> None:
    lids = flame.arrays.eyelid_dirs
    assert lids is not None
    assert flame.response.expression.shape[-1] == flame.arrays.num_expressions + 2
    marks = flame.landmarks
    upper, lower = (marks.select(np.flatnonzero(marks.facemesh_index == i)) for i in (386, 374))
    for left, right in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
        vertices = flame.arrays.v_template + lids @ np.array([left, right], np.float32)
        gap_m = places(flame.arrays, upper, vertices) - places(flame.arrays, lower, vertices)
        share = np.linalg.norm(gap_m) / 0.008
        assert share < 0.5 if left else share > 0.8, "the subject's left eye follows its own lid"


def test_what_is_no_face_is_refused(flame: FittedHead) -> None:
    head = flame.arrays
    with pytest.raises(UserError, match=r"1e\+02 times as large"):
        fitted_head(replace(head, v_template=100 * head.v_template))
    with pytest.raises(UserError, match="No face was found"):
        register(flame_shaped_arrays())


def test_a_head_without_eyeballs_is_refused() -> None:
    head = HeadArrays.embedded()
    weights = head.skinning_weights.copy()
    weights[:, 1] += weights[:, 3] + weights[:, 4]
    weights[:, 3:] = 0
    with pytest.raises(UserError, match="no eyeballs"):
        fitted_head(replace(head, skinning_weights=weights))
