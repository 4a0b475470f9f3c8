"""Bodies in plain shirts, followed by their outline."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rgbavatar_ns.head import EMBEDDED_BUST, HeadModel
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.follow import BodySighting
from rgbavatar_ns.tracking.torso.outline_motion import (
    OutlinePatch,
    OutlinePath,
    num_visits,
    outline_patch,
    outline_path,
)
from rgbavatar_ns.tracking.torso.place import BodyPlaces, place_body
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion
from rgbavatar_ns.tracking.torso.solve import run_motions

WIDTH, HEIGHT, FRAMES = 400, 300, 40
CAMERA = StillCamera(520.0, (WIDTH / 2, HEIGHT / 2), 1.2)
_Places = Float[np.ndarray, "F 3"]


@pytest.fixture(scope="module")
def body() -> BodyMesh:
    head = HeadModel.embedded(torch.float64, EMBEDDED_BUST)
    return BodyMesh.of(head, np.zeros(head.num_identity))


def matte_of(
    body: BodyMesh, neck_m: Float[np.ndarray, "3"], roll_rad: float
) -> Float[np.ndarray, "h w"]:
    """The alpha of a body, four times as fine before it is made coarse."""
    turn = Rotation.from_rotvec([0, 0, roll_rad]).as_matrix()
    placed = RigidMotion(turn, neck_m - turn @ body.neck_m)
    px = 4 * CAMERA.project(placed(body.vertices_m))
    drawn = np.zeros((4 * HEIGHT, 4 * WIDTH), np.float32)
    for triangle in np.round(px[body.faces] * 8).astype(np.int32):
        cv2.fillConvexPoly(drawn, triangle, (1.0,), shift=3)
    return cv2.resize(drawn, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def swaying(by_m: Float[np.ndarray, "3"]) -> _Places:
    """To both sides, up and down, and to the camera and away, each at its own pace."""
    phase = np.linspace(0, 2 * np.pi, FRAMES)[:, None] * [1, 2, 1.5]
    return np.array([0.0, 0.03, 0.0]) + by_m * np.sin(phase)


def patches_of(body: BodyMesh, body_m: _Places, roll_rad: np.ndarray, head_m: _Places):
    return [
        outline_patch(k, matte_of(body, own, roll), head, CAMERA)
        for k, (own, roll, head) in enumerate(zip(body_m, roll_rad, head_m))
    ]


def path_of(
    patches: Sequence[OutlinePatch], head_m: _Places, cuts: Collection[int] = ()
) -> OutlinePath | None:
    follows = [k > 0 and k not in cuts for k in range(len(head_m))]
    visits: list[int] = []
    path = outline_path(patches, head_m, CAMERA, follows, lambda: visits.append(1))
    assert len(visits) == num_visits(len(patches)), "or progress would stand or leap"
    return path


def off_mean(values: np.ndarray) -> np.ndarray:
    return values - np.median(values, axis=0)


def test_a_plain_body_is_where_its_outline_is(body: BodyMesh) -> None:
    """Its head goes elsewhere, by centimetres: that moves nothing."""
    drawn = np.random.default_rng(0)
    body_m = swaying(np.array([0.02, 0.015, 0.0]))
    roll = 0.06 * np.sin(np.linspace(0, 3, FRAMES))
    head_m = body_m + 0.008 * drawn.standard_normal((FRAMES, 3)) * [1, 1, 0]
    path = path_of(patches_of(body, body_m, roll, head_m), head_m)
    assert path is not None
    assert path.told.all()
    away = off_mean(path.neck_m) - off_mean(body_m)
    assert np.abs(away[:, :2]).max() < 3e-3
    assert np.degrees(np.abs(off_mean(path.roll_rad) - off_mean(roll))).max() < 1.0


def test_a_body_that_comes_nearer_than_its_head_is_nearer(body: BodyMesh) -> None:
    body_m = swaying(np.array([0.0, 0.0, 0.06]))
    head_m = np.tile(np.median(body_m, axis=0), (FRAMES, 1))
    path = path_of(patches_of(body, body_m, np.zeros(FRAMES), head_m), head_m)
    assert path is not None
    away = off_mean(path.neck_m) - off_mean(body_m)
    assert np.abs(away[:, :2]).max() < 3e-3
    assert np.abs(away[:, 2]).mean() < 0.4 * np.abs(off_mean(body_m)[:, 2]).mean()


def test_a_body_that_keeps_still_does_so_to_the_bit(body: BodyMesh) -> None:
    """Whatever its head does, to the camera and away too."""
    drawn = np.random.default_rng(1)
    body_m = np.tile([0.01, 0.02, 0.0], (FRAMES, 1))
    head_m = body_m + drawn.uniform(-1, 1, (FRAMES, 3)) * [0.01, 0.005, 0.02]
    path = path_of(patches_of(body, body_m, np.zeros(FRAMES), head_m), head_m)
    assert path is not None
    assert np.array_equal(path.neck_m, np.tile(path.neck_m[:1], (FRAMES, 1)))
    assert not path.roll_rad.any()


def test_frames_that_show_no_shoulders_are_between_those_that_do(body: BodyMesh) -> None:
    """On a straight line, wherever their heads go."""
    body_m = swaying(np.array([0.03, 0.01, 0.0]))
    patches = patches_of(body, body_m, np.zeros(FRAMES), body_m)
    hidden = [k for k in range(FRAMES) if 12 <= k < 18]
    unseen = np.full_like(patches[0].alpha, 255)
    some = [OutlinePatch(k, unseen) if k in hidden else one for k, one in enumerate(patches)]
    path = path_of(some, body_m)
    assert path is not None
    np.testing.assert_array_equal(np.flatnonzero(~path.told), hidden)
    away = np.abs(off_mean(path.neck_m) - off_mean(body_m))[:, :2]
    assert away[path.told].max() < 3e-3
    ends = path.neck_m[[11, 18]]
    straight = ends[0] + np.linspace(0, 1, 8)[1:-1, None] * (ends[1] - ends[0])
    np.testing.assert_allclose(path.neck_m[hidden], straight, atol=1e-12)
    assert path_of([OutlinePatch(0, unseen)], body_m) is None
    assert path_of([], body_m) is None


def test_a_head_moves_no_body_between_the_frames_that_tell_of_it(body: BodyMesh) -> None:
    """Every fourth frame is looked at, or a part of the film shows no shoulders."""
    body_m = np.tile([0.01, 0.02, 0.0], (FRAMES, 1))
    head_m = body_m + 0.012 * np.sin(np.arange(FRAMES))[:, None] * [1, 0.3, 0]
    patches = patches_of(body, body_m, np.zeros(FRAMES), head_m)
    for some in (patches[::4], [*patches[:12], *patches[24:]]):
        path = path_of(some, head_m)
        assert path is not None
        assert np.array_equal(path.neck_m, np.tile(path.neck_m[:1], (FRAMES, 1)))
        assert np.abs(path.neck_m[0] - body_m[0])[:2].max() < 6e-3


def test_a_body_that_is_not_seen_for_long_goes_with_its_head(body: BodyMesh) -> None:
    """Worked by hand: both walk 2 mm a frame; the last fifteen frames show no shoulders."""
    body_m = np.array([0.0, 0.02, 0.0]) + 0.002 * np.arange(FRAMES)[:, None] * [1, 0, 0]
    path = path_of(patches_of(body, body_m, np.zeros(FRAMES), body_m)[:25], body_m)
    assert path is not None
    np.testing.assert_allclose(path.neck_m[-1] - path.neck_m[0], [0.078, 0, 0], atol=3e-3)


def test_each_part_of_a_film_keeps_still_where_it_does(body: BodyMesh) -> None:
    """Worked by hand: a person sits 50 mm farther right after a cut, and keeps still in both."""
    cut = FRAMES // 2
    body_m = np.array([0.0, 0.02, 0.0]) + 0.05 * (np.arange(FRAMES) >= cut)[:, None] * [1, 0, 0]
    patches = patches_of(body, body_m, np.zeros(FRAMES), body_m)
    path = path_of([*patches[: cut - 3], *patches[cut + 3 :]], body_m, [cut])
    assert path is not None
    for part in (path.neck_m[:cut], path.neck_m[cut:]):
        assert np.array_equal(part, np.tile(part[:1], (len(part), 1)))
    np.testing.assert_allclose(path.neck_m[-1] - path.neck_m[0], [0.05, 0, 0], atol=2e-3)


def test_a_wall_of_hair_or_an_empty_matte_tells_no_place(body: BodyMesh) -> None:
    neck_m = np.array([0.0, 0.03, 0.0])
    for level in (0.0, 1.0):
        matte = np.full((HEIGHT, WIDTH), level, np.float32)
        patches = [outline_patch(k, matte, neck_m, CAMERA) for k in range(4)]
        assert path_of(patches, np.tile(neck_m, (4, 1))) is None


def unseen(frames: int) -> list[BodySighting]:
    """A shirt without a pattern."""
    none = np.zeros((0, 2))
    return [BodySighting(0, none, none, np.zeros((0, 2, 2)), np.nan) for _ in range(frames)]


def placed_by(body: BodyMesh, path: OutlinePath | None, head_m: _Places) -> BodyPlaces:
    follows = [k > 0 for k in range(len(head_m))]
    return place_body(body, CAMERA, 1.0, unseen(len(head_m)), head_m, follows, [], path)


def test_a_plain_shirt_goes_by_its_outline_and_without_one_stays(body: BodyMesh) -> None:
    head_m = swaying(np.array([0.02, 0.01, 0.0]))
    roll = 0.05 * np.sin(np.linspace(0, 3, FRAMES))
    path = OutlinePath(head_m - [0.0, 0.01, 0.0], roll, np.ones(FRAMES, bool))
    places = placed_by(body, path, head_m)
    assert not places.still
    assert places.outlined == 1
    # But for what smoothing takes from a sway of forty frames.
    np.testing.assert_allclose(places.neck_m, path.neck_m, atol=3e-3)
    tilt = Rotation.from_matrix(places.rotation).as_rotvec()[:, 2]
    np.testing.assert_allclose(off_mean(tilt), off_mean(roll), atol=4e-3)
    still = placed_by(body, None, head_m)
    assert still.still
    assert np.array_equal(still.neck_m, np.tile(still.neck_m[:1], (FRAMES, 1)))


def test_what_the_pattern_says_beyond_the_outline_goes_on_between(body: BodyMesh) -> None:
    """Worked by hand: the clothes are 10 mm beside the outline's path where they are followed, in
    the first and the last four frames, and so they are between."""
    frames = 16
    outline_m = np.linspace([0.0, 0.02, 0.0], [0.05, 0.02, 0.0], frames)
    gap = 0.01 * np.minimum(np.arange(frames) / 3, 1)[:, None] * [0.0, 1.0, 0.0]
    clothes_m = outline_m + gap
    drawn = np.random.default_rng(2)
    spots_px = drawn.uniform([150, 180], [250, 250], (60, 2))
    start = RigidMotion(np.eye(3), clothes_m[0] - body.neck_m)
    points_m, near = body.lifted(spots_px, start, CAMERA)
    none = np.zeros((0, 2))
    run = [BodySighting(0, none, spots_px, np.tile(np.eye(2), (60, 1, 1)), 0.0)]
    for k in range(1, frames):
        seen = near & (k < 4 or k >= frames - 4)
        px = CAMERA.project(points_m + clothes_m[k] - clothes_m[0])
        run.append(BodySighting(0, np.where(seen[:, None], px, np.nan), None, None, 0.0))
    path = OutlinePath(outline_m, np.zeros(frames), np.ones(frames, bool))
    follows = [k > 0 for k in range(frames)]
    places = place_body(body, CAMERA, 1.0, run, clothes_m, follows, [], path)
    assert places.followed == pytest.approx(0.5)
    moved = places.neck_m - places.neck_m[-1]
    np.testing.assert_allclose(moved[5:], (clothes_m - clothes_m[-1])[5:], atol=3e-3)


def test_a_body_that_is_lost_goes_on_by_its_outline(body: BodyMesh) -> None:
    """Worked by hand: 8 mm a frame; the pattern is lost in the fourth, and chosen anew."""
    frames = 8
    body_m = np.array([0.0, 0.02, 0.0]) + 0.008 * np.arange(frames)[:, None] * [1, 0, 0]
    spots_px = np.random.default_rng(4).uniform([150, 180], [250, 250], (60, 2))
    certain, none = np.tile(np.eye(2), (60, 1, 1)), np.zeros((0, 2))

    def seen(spots: np.ndarray, first: int, k: int) -> np.ndarray:
        placed = RigidMotion(np.eye(3), body_m[first] - body.neck_m)
        points_m, near = body.lifted(spots, placed, CAMERA)
        px = CAMERA.project(points_m + body_m[k] - body_m[first])
        return np.where(near[:, None], px, np.nan)

    run = [BodySighting(0, none, spots_px, certain, 0.0)]
    run += [BodySighting(0, seen(spots_px, 0, k), None, None, 0.0) for k in (1, 2)]
    run += [BodySighting(0, np.full((60, 2), np.nan), spots_px, certain, 0.0)]
    run += [BodySighting(0, seen(spots_px, 3, k), None, None, 0.0) for k in range(4, frames)]
    path = OutlinePath(body_m, np.zeros(frames), np.ones(frames, bool))
    start = RigidMotion(np.eye(3), body_m[0] - body.neck_m)
    found = run_motions(body, CAMERA, 1.0, run, start, path.motions(), lambda: None)
    assert [one is None for one in found] == [k == 3 for k in range(frames)]
    last = found[-1]
    assert last is not None
    np.testing.assert_allclose(last(body_m[0]), body_m[-1], atol=1e-3)


def followed(
    body: BodyMesh, count: int, start_m: Float[np.ndarray, "3"], by_m: _Places
) -> list[BodySighting]:
    """So many points of a shirt that rests at a place, moved from the first frame on."""
    spots_px = np.random.default_rng(6).uniform([150, 190], [250, 250], (count, 2))
    start = RigidMotion(np.eye(3), start_m - body.neck_m)
    points_m, near = body.lifted(spots_px, start, CAMERA)
    assert near.all()
    none, certain = np.zeros((0, 2)), np.tile(np.eye(2), (count, 1, 1))
    seen = [CAMERA.project(points_m + shift) for shift in by_m[1:]]
    run = [BodySighting(0, none, spots_px, certain, 0.0)]
    return run + [BodySighting(0, px, None, None, 0.0) for px in seen]


@pytest.mark.parametrize(("count", "believed"), [(12, False), (30, False), (60, True)])
def test_few_points_that_stay_where_they_are_do_not_hold_a_body_that_moves(
    body: BodyMesh, count: int, believed: bool
) -> None:
    """A film's compression holds them; so many that they are the shirt's own are believed, since
    arms move outlines too. Worked by hand: 2 mm a frame."""
    body_m = np.array([0.0, 0.02, 0.0]) + 0.002 * np.arange(FRAMES)[:, None] * [1, 0, 0]
    run = followed(body, count, body_m[0], np.zeros((FRAMES, 3)))
    path = OutlinePath(body_m, np.zeros(FRAMES), np.ones(FRAMES, bool))
    follows = [k > 0 for k in range(FRAMES)]
    head_m = np.tile(body_m.mean(0), (FRAMES, 1))
    places = place_body(body, CAMERA, 1.0, run, head_m, follows, [], path)
    went = places.neck_m[-1] - places.neck_m[0]
    np.testing.assert_allclose(went, [0.0 if believed else 0.078, 0, 0], atol=3e-3)
    assert places.still == believed


@pytest.mark.parametrize("told", [True, False])
def test_a_frame_that_shows_few_points_goes_by_its_outline_if_that_tells(
    body: BodyMesh, told: bool
) -> None:
    """Worked by hand: the body keeps still; in a third of the frames a dozen points of sixty are
    left, and go 10 mm to the side."""
    still_m, few = np.tile([0.0, 0.02, 0.0], (FRAMES, 1)), np.arange(FRAMES) % 3 == 2
    run = followed(body, 60, still_m[0], 0.01 * few[:, None] * [1, 0, 0])
    left = np.arange(60)[:, None] < 12
    run = [
        replace(one, seen_px=np.where(left, one.seen_px, np.nan)) if little else one
        for one, little in zip(run, few)
    ]
    path = OutlinePath(still_m, np.zeros(FRAMES), np.full(FRAMES, True) if told else ~few)
    follows = [k > 0 for k in range(FRAMES)]
    places = place_body(body, CAMERA, 1.0, run, still_m, follows, [], path)
    assert places.still == told
    assert places.followed == pytest.approx(1 - told * few.mean())


def test_few_points_that_go_with_the_outline_tell_more_than_it_does(body: BodyMesh) -> None:
    """Worked by hand: the body comes 1 mm nearer in each frame, which the outline does not see."""
    along = np.array([0.0, 0.02, 0.0]) + 0.002 * np.arange(FRAMES)[:, None] * [1, 0, 0]
    nearer = 0.001 * np.arange(FRAMES)[:, None] * [0, 0, 1]
    run = followed(body, 30, along[0], along + nearer - along[0])
    path = OutlinePath(along, np.zeros(FRAMES), np.ones(FRAMES, bool))
    follows = [k > 0 for k in range(FRAMES)]
    places = place_body(body, CAMERA, 1.0, run, along + nearer, follows, [], path)
    assert places.followed == 1.0
    went = places.neck_m[-1] - places.neck_m[0]
    np.testing.assert_allclose(went, [0.078, 0, 0.039], atol=5e-3)
