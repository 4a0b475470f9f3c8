"""Bodies in hard films: arms before them, somebody beside, a chair behind, none in the picture."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from rgbavatar_ns.head import EMBEDDED_BUST, HeadModel
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.body_blocks import BodyBlock
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.follow import BodyFollower, BodySighting, FollowerState
from rgbavatar_ns.tracking.torso.place import place_body
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion
from rgbavatar_ns.tracking.torso.shape import shoulder_line, shoulders_up_cm
from rgbavatar_ns.tracking.torso.shown import beside_share, body_shown, seen_cm2

SIZE, FRAMES = 320, 16
CAMERA = StillCamera(560.0, (160.0, 160.0), 1.1)
NECK_M = np.array([0.0, 0.0, 0.0])
_Pictures = UInt8[np.ndarray, "F S S 3"]


def one_stretch(frames: int) -> list[bool]:
    """That each frame comes directly after the one before it."""
    return [k > 0 for k in range(frames)]


def speckled(seed: int, low: int, high: int) -> Float[np.ndarray, "S S 3"]:
    """Cloth whose every place looks otherwise, between two levels."""
    drawn = np.random.default_rng(seed).standard_normal((SIZE, SIZE, 3))
    soft = cv2.GaussianBlur(drawn, (0, 0), 2.5)
    soft = (soft - soft.min()) / np.ptp(soft)
    return low + (high - low) * soft


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return HeadModel.embedded(torch.float64, EMBEDDED_BUST)


@pytest.fixture(scope="module")
def vertices_m(head: HeadModel) -> Float[np.ndarray, "V 3"]:
    """The whole person at rest, the neck's joint where `NECK_M` is."""
    with torch.no_grad():
        rest = head(torch.zeros(head.layout.size, dtype=torch.float64)).numpy()
    return rest - BodyMesh.of(head, np.zeros(head.num_identity)).neck_m + NECK_M


class Still:
    """A person in a speckled shirt before a speckled wall; everything keeps still."""

    def __init__(self, head: HeadModel, vertices_m: Float[np.ndarray, "V 3"]) -> None:
        self.body = BodyMesh.of(head, np.zeros(head.num_identity))
        self.vertices_px = CAMERA.project(vertices_m)
        drawn = np.zeros((SIZE, SIZE), np.uint8)
        for triangle in np.round(self.vertices_px[head.arrays.faces] * 8).astype(np.int32):
            cv2.fillConvexPoly(drawn, triangle, (1,), shift=3)
        self.matte = drawn.astype(np.float32)
        picture = np.where(drawn[..., None] > 0, speckled(0, 60, 140), speckled(1, 120, 220))
        self.images = np.repeat(picture.astype(np.uint8)[None], FRAMES, axis=0)

    def followed(
        self, images: _Pictures, follow: BodyFollower | None = None, first: int = 0
    ) -> list[BodySighting]:
        follow = follow or self.follower()
        return [
            follow(image, NECK_M, lambda: self.matte, lambda: self.vertices_px, k == 0)
            for k, image in enumerate(images, first)
        ]

    def follower(self, state: FollowerState | None = None) -> BodyFollower:
        return BodyFollower(self.body, CAMERA, 1.0, state)


@pytest.fixture(scope="module")
def still(head: HeadModel, vertices_m: Float[np.ndarray, "V 3"]) -> Still:
    return Still(head, vertices_m)


def with_arm(images: _Pictures) -> _Pictures:
    """A speckled arm rises before the chest in the middle of the film, and goes."""
    result, sleeve = images.copy(), speckled(2, 20, 230)
    sleeve[..., 2] *= 0.3
    for k in range(4, FRAMES - 3):
        top = SIZE - 12 * (k - 3)
        result[k, top:, 110:190] = sleeve[: SIZE - top, 110:190]
    return result


def with_print(still: Still, side: int) -> _Pictures:
    """The shirt is plain but for a speckled square."""
    top, left = SIZE - 10 - side, SIZE // 2 - side // 2
    images = np.where((still.matte > 0)[..., None], np.uint8(100), still.images)
    spots = np.s_[:, top : top + side, left : left + side]
    images[spots] = still.images[spots]
    return images


def test_an_arm_before_the_chest_is_said_and_does_not_move_the_body(still: Still) -> None:
    sightings = still.followed(with_arm(still.images))
    covered = np.array([one.covered for one in sightings])
    assert (covered[2:4] < 0.02).all()
    assert covered[FRAMES - 5] > 0.1
    assert (covered[FRAMES - 3 :] < 0.02).all(), "the arm is gone, and was not learned"
    places = place_body(
        still.body, CAMERA, 1.0, sightings, np.tile(NECK_M, (FRAMES, 1)), one_stretch(FRAMES), []
    )
    assert places.still
    assert 0.3 < places.covered_share < 0.6
    moves = place_body(
        still.body,
        CAMERA,
        1.0,
        still.followed(still.images),
        np.tile(NECK_M, (FRAMES, 1)),
        one_stretch(FRAMES),
        [],
    )
    assert moves.covered_share == 0


def test_points_are_kept_where_too_few_can_be_chosen_anew(still: Still) -> None:
    """An arm hides most of them, and the matte is empty meanwhile: what is left is followed on."""
    images, sleeve = with_print(still, 130), speckled(2, 20, 230)
    top = SIZE - 60
    images[3:-3, top:, 70:250] = sleeve[top:, 70:250] * [1, 1, 0.3]
    mattes = [still.matte * (k < 3 or k >= FRAMES - 3) for k in range(FRAMES)]
    follow = still.follower()
    sightings = [
        follow(image, NECK_M, lambda m=matte: m, lambda: still.vertices_px, k == 0)
        for k, (image, matte) in enumerate(zip(images, mattes))
    ]
    counts = [one.num_seen for one in sightings[1:]]
    assert min(counts) < 0.4 * max(counts)
    assert all(one.is_followed for one in sightings[1:])
    assert {one.run for one in sightings} == {0}
    assert [k for k, one in enumerate(sightings) if one.chosen_px is not None] == [0]
    assert counts[-1] == counts[0]


def test_light_that_changes_covers_nothing(still: Still) -> None:
    brighter = np.linspace(0, 30, FRAMES)[:, None, None, None]
    sightings = still.followed((still.images + brighter).astype(np.uint8))
    assert np.nanmax([one.covered for one in sightings]) < 0.02


def test_a_body_that_comes_back_is_found_where_it_was(still: Still) -> None:
    """It goes half out of the picture, where another key picture is taken, and comes back."""
    sway = np.round(200 * np.sin(np.linspace(0, np.pi, 57))).astype(int).tolist()
    shown = still.images[0]
    follow = BodyFollower(still.body, CAMERA, 1.0)
    sightings = []
    for k, step in enumerate(sway):
        picture = np.roll(shown, step, axis=1)
        matte = np.roll(still.matte, step, axis=1)
        mesh_px = still.vertices_px + np.array([step, 0])
        sightings.append(follow(picture, NECK_M, lambda m=matte: m, lambda px=mesh_px: px, k == 0))
    assert {one.run for one in sightings} == {0}
    assert sum(one.chosen_px is not None for one in sightings) > 1
    assert sightings[-1].of_first
    corners = still.body.vertices_m
    apart = CAMERA.project(follow.state.motion(corners)) - CAMERA.project(corners)
    assert np.abs(apart).max() < 0.5


def test_following_goes_on_alike_from_what_was_kept(still: Still, tmp_path: Path) -> None:
    images = with_arm(still.images)
    whole = still.followed(images)
    for border in (1, 9):
        begun = still.follower()
        before = still.followed(images[:border], begun)
        BodyBlock(before, [], [], [], [], begun.state).save(tmp_path / "body.npz")
        kept = BodyBlock.load(tmp_path / "body.npz")
        again = still.followed(images[border:], still.follower(kept.state), border)
        for one, other in zip(whole, [*kept.sightings, *again], strict=True):
            assert (one.run, one.of_first) == (other.run, other.of_first)
            for name in ("seen_px", "chosen_px", "certainty", "background_px", "covered"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(("moving", "told_px"), [("neighbour", 0.3), ("camera", 8.0)])
def test_somebody_who_moves_beside_the_person_is_no_moving_camera(
    still: Still, moving: str, told_px: float
) -> None:
    images = still.images.copy()
    for k in range(FRAMES):
        part = images[k, :, SIZE - 70 :] if moving == "neighbour" else images[k]
        part[:] = np.roll(part, k, axis=0)
    told = np.nanmax([one.background_px for one in still.followed(images)])
    assert told < told_px if moving == "neighbour" else told > told_px


def test_a_motion_that_no_body_under_the_head_makes_is_not_believed(still: Still) -> None:
    """Points that were chosen on the body go off with what covered it: the body stays."""
    chosen = still.followed(still.images[:1])[0]
    assert chosen.chosen_px is not None
    none = np.zeros((0, 2))
    gone = [
        BodySighting(0, chosen.chosen_px - (0, 14 * max(0, k - 8)), None, None, np.nan)
        for k in range(1, FRAMES)
    ]
    first = BodySighting(0, none, chosen.chosen_px, chosen.certainty, np.nan)
    places = place_body(
        still.body,
        CAMERA,
        1.0,
        [first, *gone],
        np.tile(NECK_M, (FRAMES, 1)),
        one_stretch(FRAMES),
        [],
    )
    assert places.followed < 1
    assert np.linalg.norm(places.neck_m - NECK_M, axis=1).max() < 0.09


def test_a_body_in_the_picture_is_told_from_none(
    still: Still, head: HeadModel, vertices_m: Float[np.ndarray, "V 3"]
) -> None:
    whole = body_shown(0, still.matte, still.body, NECK_M, still.vertices_px, CAMERA)
    assert whole.seen_cm2 > 500
    assert whole.alone
    cropped = still.matte[: int(CAMERA.project(NECK_M)[1])]
    none = body_shown(1, cropped, still.body, NECK_M, still.vertices_px, CAMERA)
    assert none.seen_cm2 == 0
    assert seen_cm2([whole, none, none]) == 0
    sightings = [
        BodyFollower(still.body, CAMERA, 1.0)(
            *(still.images[0][: len(cropped)], NECK_M),
            *(lambda: cropped, lambda: still.vertices_px),
            True,
        )
    ]
    places = place_body(still.body, CAMERA, 1.0, sightings, NECK_M[None], one_stretch(1), [])
    assert places.still
    np.testing.assert_allclose(places.neck_m, NECK_M[None], atol=1e-12)


def test_a_neighbours_shoulder_in_the_matte_is_seen_beside(still: Still) -> None:
    both = still.matte.copy()
    both[150:, :14] = both[:60, SIZE - 60 :] = 1
    shown = [
        body_shown(k, matte, still.body, NECK_M, still.vertices_px, CAMERA)
        for k, matte in enumerate((still.matte, both))
    ]
    assert shown[0].alone
    assert not shown[1].alone
    assert beside_share(shown) == 0.5


def test_a_chair_behind_the_shoulders_does_not_raise_them(still: Still) -> None:
    chair = still.matte.copy()
    chair[60:260, 70:250] = 1
    lines = [shoulder_line(k, chair, NECK_M, CAMERA) for k in range(6)]
    assert np.nanmedian(lines[0].above_cm) > 10
    assert shoulders_up_cm(still.body, CAMERA, lines, np.tile(np.eye(3), (6, 1, 1))) == 0.0


def sightings_of(
    still: Still,
    motions: Sequence[RigidMotion],
    unseen: Collection[int] = (),
    noise_px: float = 0.0,
) -> list[BodySighting]:
    """One run: points on the shirt where these motions carry them, but for frames without any."""
    chosen = still.followed(still.images[:1])[0]
    assert chosen.chosen_px is not None
    placed = RigidMotion(np.eye(3), NECK_M - still.body.neck_m)
    points, near = still.body.lifted(chosen.chosen_px, placed, CAMERA)
    drawn, none = np.random.default_rng(3), np.zeros((0, 2))
    run = [BodySighting(0, none, chosen.chosen_px, chosen.certainty, 0.0)]
    for k, motion in enumerate(motions[1:], 1):
        px = CAMERA.project(motion(points))
        px += noise_px * drawn.standard_normal(px.shape)
        seen = near & (k not in unseen)
        run.append(BodySighting(0, np.where(seen[:, None], px, np.nan), None, None, 0.1))
    return run


def test_frames_without_a_motion_lie_between_those_with_one(still: Still) -> None:
    """Worked by hand: 30 mm in 6 frames, of which the middle ones see nothing."""
    steps = 0.03 * np.linspace(0, 1, 7)[:, None] * [1.0, 0, 0]
    run = sightings_of(still, [RigidMotion(np.eye(3), step) for step in steps], (2, 3, 4))
    necks = NECK_M + steps
    places = place_body(still.body, CAMERA, 1.0, run, necks, one_stretch(7), [])
    assert places.followed == pytest.approx(4 / 7)
    np.testing.assert_allclose(places.neck_m[3], necks[3], atol=2e-3)


def test_nothing_is_smoothed_or_bridged_where_a_film_leaves_something_out(still: Still) -> None:
    """Worked by hand: a body is 30 mm elsewhere from the 8th frame on, and still before and after.

    The frames about that one see nothing; of the third stretch none does.
    """
    frames, borders = 16, (8, 14)
    follows = [k > 0 and k not in borders for k in range(frames)]
    steps = 0.03 * (np.arange(frames) >= borders[0])[:, None] * [1.0, 0, 0]
    motions = [RigidMotion(np.eye(3), step) for step in steps]
    run = sightings_of(still, motions, (6, 7, 8, 9, 14, 15))
    places = place_body(still.body, CAMERA, 1.0, run, NECK_M + steps, follows, [])
    assert places.followed == pytest.approx(10 / 16)
    np.testing.assert_allclose(places.neck_m, NECK_M + steps, atol=2e-3)


@pytest.mark.parametrize(("side", "is_followed"), [(24, False), (130, True)])
def test_a_shirt_with_too_few_points_to_follow_keeps_still(
    still: Still, side: int, is_followed: bool
) -> None:
    """As a collar at the end of the picture shows it, or a logo: none of it is followed."""
    sightings = still.followed(with_print(still, side))
    for one in sightings:
        assert one.is_followed == (is_followed and one is not sightings[0])
    chosen_px = sightings[0].chosen_px
    assert chosen_px is not None
    assert bool(len(chosen_px)) == is_followed
    heads = np.tile(NECK_M, (FRAMES, 1))
    places = place_body(still.body, CAMERA, 1.0, sightings, heads, one_stretch(FRAMES), [])
    assert places.followed == is_followed
    np.testing.assert_allclose(places.neck_m, heads, atol=1e-9 if not is_followed else 2e-3)


def test_a_larger_film_of_the_same_body_shows_the_same_motions(still: Still) -> None:
    """The body is followed in a small picture, whatever the film's size: so are its errors."""
    hip = NECK_M - [0.0, 0.4, 0.0]
    turns = Rotation.from_rotvec(0.15 * np.sin(np.arange(32) / 4)[:, None] * [0.0, 0.0, 1.0])
    motions = [RigidMotion(turn, hip - turn @ hip) for turn in turns.as_matrix()]
    run = sightings_of(still, motions, noise_px=0.4)
    necks = np.array([motion(NECK_M) for motion in motions])
    by = 6.0
    camera = replace(CAMERA, focal_px=by * CAMERA.focal_px, center_px=(by * SIZE / 2,) * 2)
    larger = [
        replace(
            one,
            seen_px=by * one.seen_px,
            chosen_px=None if one.chosen_px is None else by * one.chosen_px,
            background_px=by * one.background_px,
        )
        for one in run
    ]
    small = place_body(still.body, CAMERA, 1.0, run, necks, one_stretch(len(run)), [])
    large = place_body(still.body, camera, 1 / by, larger, necks, one_stretch(len(run)), [])
    assert small.followed == large.followed == 1
    assert small.report()["turned_degrees"] > 4, "it does lean"
    np.testing.assert_allclose(large.rotation, small.rotation, atol=1e-6)
    np.testing.assert_allclose(large.neck_m, small.neck_m, atol=1e-6)
    assert large.background_px == pytest.approx(by * small.background_px)
    assert small.background_stands
    assert large.background_stands, "six pixels of the film are one of what was looked at"
