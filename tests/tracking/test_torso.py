"""The body under the head: followed by its clothes, never turned by the head."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import EMBEDDED_BUST, HeadModel
from rgbavatar_ns.head.joints import NECK
from rgbavatar_ns.head.landmarks import facemesh_landmarks
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoFilm, film_demo
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead
from rgbavatar_ns.tracking.torso.body_blocks import BodyBlock
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.compose import on_body
from rgbavatar_ns.tracking.torso.features import FollowedPoints
from rgbavatar_ns.tracking.torso.follow import BodyFollower, BodySighting, FollowerState
from rgbavatar_ns.tracking.torso.outline_motion import OutlinePatch
from rgbavatar_ns.tracking.torso.place import BodyPlaces, SeenShoulders, place_body
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion, fit_rigid_motion
from rgbavatar_ns.tracking.torso.shape import ShoulderLine, shoulder_line, shoulders_up_cm
from rgbavatar_ns.tracking.torso.shown import BodyShown

SIZE, FRAMES = 320, 24
ONE_STRETCH = [False] + [True] * (FRAMES - 1)
CAMERA = StillCamera(700.0, (160.0, 160.0), 1.1)


@pytest.fixture(scope="module")
def bust() -> HeadModel:
    return HeadModel.embedded(torch.float64, EMBEDDED_BUST)


def degrees(first: np.ndarray, second: np.ndarray) -> Float[np.ndarray, "F"]:
    """Angles between rotations."""
    return np.degrees(Rotation.from_matrix(first @ second.swapaxes(-1, -2)).magnitude())


def turned(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Float[np.ndarray, "3 3"]:
    return Rotation.from_rotvec(np.radians([pitch, yaw, roll])).as_matrix()


def test_a_head_put_on_a_body_stays_where_it_was(bust: HeadModel) -> None:
    drawn = np.random.default_rng(0)
    layout, identity = bust.layout, 0.7 * drawn.standard_normal(bust.num_identity)
    identity[-2:] = 0
    theta = np.zeros((5, layout.size))
    theta[:, layout.slice("rotation")] = 0.4 * drawn.standard_normal((5, 3))
    theta[:, layout.slice("translation")] = 0.1 * drawn.standard_normal((5, 3))
    theta[:, layout.slice("jaw").start] = 0.2
    theta[:, :40] = drawn.uniform(0, 0.5, (5, 40))
    marks = facemesh_landmarks()
    ids = bust.arrays.faces[marks.triangle].astype(np.int64)
    head = LandmarkHead(bust, ids, marks.barycentric)
    necks = np.array([head.chain(row, identity).placed[NECK] for row in theta])
    moved = necks + 0.008 * drawn.standard_normal((5, 3))
    bodies = np.array([turned(*drawn.uniform(-10, 10, 3)) for _ in range(5)])
    places = BodyPlaces(bodies, moved, False, 1.0, 0.0, shoulders_up_cm=3.0)
    person, found = on_body(head, bust.arrays, identity, theta, places)

    before, after = (
        bust(torch.from_numpy(rows), torch.from_numpy(who)).numpy()
        for rows, who in ((theta, identity), (found, person))
    )
    skull = bust.arrays.skinning_weights[:, NECK:].sum(1) > 0.999
    assert skull.sum() > 2500
    np.testing.assert_allclose(after[:, skull], before[:, skull], atol=3e-4)
    root = axis_angle_to_matrix(torch.from_numpy(found[:, layout.slice("rotation")])).numpy()
    np.testing.assert_allclose(root, bodies, atol=1e-9)


def test_a_body_too_far_from_its_head_follows_it(bust: HeadModel) -> None:
    identity = np.zeros(bust.num_identity)
    head = LandmarkHead(bust, np.array([[0, 1, 2]]), np.full((1, 3), 1 / 3))
    theta = np.zeros((1, bust.layout.size))
    far = head.chain(theta[0], identity).placed[NECK][None] + [0.2, 0, 0]
    places = BodyPlaces(np.eye(3)[None], far, True, 1.0, 0.0)
    _, found = on_body(head, bust.arrays, identity, theta, places)
    assert found[:, bust.layout.slice("translation")][0, 0] == pytest.approx(0.03, abs=0.002)
    teeth = bust.arrays.vertex_groups["upper_teeth"]
    vertices = bust(torch.from_numpy(found)).numpy()[0]
    np.testing.assert_allclose(vertices[teeth], bust.arrays.v_template[teeth], atol=1e-4)


def test_a_known_motion_is_found_among_points_that_lie() -> None:
    drawn = np.random.default_rng(1)
    points = drawn.uniform([-0.2, -0.3, -0.1], [0.2, -0.1, 0.1], (80, 3))
    true = RigidMotion(turned(1.2, 0.8, -1.5), np.array([0.002, -0.004, 0.003]))
    seen = CAMERA.project(true(points))
    seen[:16] += 12 * drawn.standard_normal((16, 2))
    certain = np.tile(np.eye(2), (80, 1, 1))
    motion, pivot = RigidMotion.none(), np.array([0.0, -0.05, 0.0])
    for _ in range(3):  # frame after frame it comes nearer
        fitted = fit_rigid_motion(points, seen, certain, CAMERA, 1.0, motion, pivot)
        assert fitted is not None
        motion, error_px = fitted
    assert degrees(motion.rotation, true.rotation) < 0.2
    assert np.linalg.norm(motion.shift_m - true.shift_m) < 0.002
    assert error_px < 0.5


def test_points_that_agree_on_nothing_are_no_motion() -> None:
    drawn = np.random.default_rng(2)
    points = drawn.uniform(-0.2, 0.2, (40, 3))
    certain = np.tile(np.eye(2), (40, 1, 1))
    seen = drawn.uniform(0, 320, (40, 2))
    none = RigidMotion.none()
    assert fit_rigid_motion(points, seen, certain, CAMERA, 1.0, none, np.zeros(3)) is None
    few = slice(0, 5)
    assert (
        fit_rigid_motion(points[few], seen[few], certain[few], CAMERA, 1.0, none, np.zeros(3))
        is None
    )


def test_a_point_on_a_stripe_counts_only_across_it() -> None:
    rows = np.mgrid[:200, :200][0]
    stripes = (127 + 100 * np.sin(rows / 4)).astype(np.uint8)
    stripes += np.random.default_rng(3).integers(0, 4, stripes.shape).astype(np.uint8)
    chosen = FollowedPoints.chosen(stripes, np.ones((200, 200), bool), 160)
    assert len(chosen.points_px) > 20
    assert chosen.certainty[:, 0, 0].max() < 0.2, "along the stripe nothing is known"
    assert chosen.certainty[:, 1, 1].min() > 0.8


def test_points_in_a_line_are_found_again() -> None:
    """As along a strap: across them nothing says how the picture turned or grew."""
    picture = np.random.default_rng(5).integers(0, 255, (200, 200)).astype(np.uint8)
    points = np.stack([np.arange(40.0, 160, 10)] * 2, axis=1)
    chosen = FollowedPoints(picture, points, np.tile(np.eye(2), (len(points), 1, 1)))
    moved, there = np.roll(picture, (3, 5), axis=(0, 1)), points + np.array([5, 3])
    found_px, found = chosen.found_in(moved, there)
    assert found.all()
    np.testing.assert_allclose(found_px, there, atol=0.1)


@pytest.fixture(scope="module")
def films() -> Callable[[str], tuple[DemoFilm, UInt8[np.ndarray, "F S S 4"]]]:
    made: dict[str, tuple[DemoFilm, np.ndarray]] = {}

    def film(body: str) -> tuple[DemoFilm, np.ndarray]:
        if body not in made:
            config = DemoConfig(
                image_size=SIZE,
                num_frames=FRAMES,
                num_test_frames=4,
                seed=6,
                frames_per_second=12.0,
                theta_noise=0.0,
                supersampling=1,
                glasses=False,
                body=body,
            )
            shot = film_demo(config)
            made[body] = shot, np.stack([frame.image_rgba for frame in shot.frames()])
        return made[body]

    return film


class Filmed:
    """A procedural person as the tracker meets it: pictures, mesh, where heads say the neck is."""

    def __init__(self, film: DemoFilm, images: UInt8[np.ndarray, "F S S 4"], drift_px=0) -> None:
        head, person = film.person.head, film.person.identity
        layout, camera = head.layout, film.person.camera
        self.camera = StillCamera(camera.focal_px, (SIZE / 2, SIZE / 2), camera.distance_m)
        up = np.array([0, -camera.height_m, 0])
        with torch.no_grad():
            vertices = head(film.true, person).double().numpy() + up
        self.vertices_px = self.camera.project(vertices)
        self.rotation = (
            axis_angle_to_matrix(film.true[:, layout.slice("rotation")]).double().numpy()
        )
        root, neck = head.joints(person)[:2].double().numpy()
        shift = film.true[:, layout.slice("translation")].double().numpy()
        self.neck_m = self.rotation @ (neck - root) + root + shift + up
        room = np.random.default_rng(4).integers(60, 200, (SIZE, SIZE + 64, 3)).astype(np.float32)
        alpha = images[..., 3:].astype(np.float32) / 255
        behind = np.stack([room[:, k * drift_px % 64 :][:, :SIZE] for k in range(len(images))])
        self.images = (images[..., :3] * alpha + behind * (1 - alpha)).astype(np.uint8)
        self.mattes = alpha[..., 0]
        self.body = BodyMesh.of(head, person.double().numpy())

    def followed(self) -> list[BodySighting]:
        follow = BodyFollower(self.body, self.camera, 1.0)
        found = zip(self.images, self.neck_m, self.mattes, self.vertices_px)
        return [
            follow(image, neck, lambda m=matte: m, lambda px=px: px, k == 0)
            for k, (image, neck, matte, px) in enumerate(found)
        ]


def test_a_body_that_keeps_still_is_not_turned_by_its_head(films) -> None:
    film = Filmed(*films("still"))
    turns = np.ptp(film.vertices_px[:, 0], axis=0)
    assert turns.max() > 10, "the head does turn"
    places = place_body(film.body, film.camera, 1.0, film.followed(), film.neck_m, ONE_STRETCH, [])
    assert places.still
    assert places.followed == 1
    assert np.array_equal(places.rotation, np.tile(places.rotation[:1], (FRAMES, 1, 1)))
    assert degrees(places.rotation, film.rotation).max() < 1.5
    assert np.linalg.norm(places.neck_m - film.neck_m, axis=1).max() < 5e-3


def test_the_mesh_is_asked_for_where_points_are_chosen_alone(films) -> None:
    film, asked = Filmed(*films("still")), []

    def mesh_px() -> Float[np.ndarray, "V 2"]:
        asked.append(True)
        return film.vertices_px[0]

    follow = BodyFollower(film.body, film.camera, 1.0)
    frames = zip(film.images[:4], film.neck_m)
    seen = [
        follow(image, neck, lambda: film.mattes[0], mesh_px, k == 0)
        for k, (image, neck) in enumerate(frames)
    ]
    assert len(asked) == sum(one.chosen_px is not None for one in seen) == 1


def test_a_body_that_leans_is_followed(films) -> None:
    film = Filmed(*films("lean"))
    assert degrees(film.rotation, film.rotation[:1]).max() > 6
    places = place_body(film.body, film.camera, 1.0, film.followed(), film.neck_m, ONE_STRETCH, [])
    assert not places.still
    # How it stands on the whole one camera hardly tells: relative to its mean.
    mean = [
        Rotation.from_matrix(turns).mean().as_matrix() for turns in (places.rotation, film.rotation)
    ]
    moved = [turns @ m.T for turns, m in zip((places.rotation, film.rotation), mean)]
    assert degrees(*moved).mean() < 1.5
    away = places.neck_m - film.neck_m
    assert np.linalg.norm(away, axis=1).mean() < 5e-3


def test_another_place_of_the_background_tells_a_moving_camera(films) -> None:
    still, moving = (Filmed(*films("still"), drift_px=drift).followed() for drift in (0, 1))
    assert np.nanmax([one.background_px for one in still]) < 0.3
    assert np.nanmax([one.background_px for one in moving]) > 5


def test_a_plain_shirt_leaves_the_body_where_it_was() -> None:
    body = BodyMesh.of(HeadModel.embedded(torch.float64, EMBEDDED_BUST), np.zeros(32))
    none = np.zeros((0, 2))
    unseen = [BodySighting(k, none, none, np.zeros((0, 2, 2)), np.nan) for k in range(4)]
    necks = np.tile(np.array([[0.01], [0.02], [0.03], [0.04]]), (1, 3))
    places = place_body(body, CAMERA, 1.0, unseen, necks, ONE_STRETCH[:4], [])
    assert places.followed == 0
    assert places.still
    np.testing.assert_allclose(places.rotation, np.tile(np.eye(3), (4, 1, 1)), atol=1e-12)


@pytest.mark.parametrize(("roll_degrees", "told"), [(1.0, 0.0), (10.0, 8.0)])
def test_shoulders_tilt_a_body_only_where_they_are_plainly_aslant(
    roll_degrees: float, told: float
) -> None:
    body = BodyMesh.of(HeadModel.embedded(torch.float64, EMBEDDED_BUST), np.zeros(32))
    neck = np.array([0.0, -0.05, 0.0])
    marks = (body.shoulders_m - body.neck_m) @ turned(0, 0, roll_degrees).T + neck
    shoulders = [SeenShoulders(0, CAMERA.project(marks), 0.0)]
    none = np.zeros((0, 2))
    unseen = [BodySighting(0, none, none, np.zeros((0, 2, 2)), np.nan)]
    places = place_body(body, CAMERA, 1.0, unseen, neck[None], ONE_STRETCH[:1], shoulders)
    assert degrees(places.rotation[0], turned(0, 0, told)) < 0.3


@pytest.mark.parametrize(("up_cm", "told_cm"), [(0.0, 0.0), (4.0, 2.8), (-3.0, -2.5)])
def test_shoulders_go_to_the_outline_less_cloth_and_doubt(up_cm: float, told_cm: float) -> None:
    head = HeadModel.embedded(torch.float64, EMBEDDED_BUST)
    identity = np.zeros(head.num_identity)
    body = BodyMesh.of(head, identity)
    identity[-2] = up_cm
    person = BodyMesh.of(head, identity)
    neck = np.array([0.0, -0.05, 0.0])
    px = CAMERA.project(person.vertices_m - person.neck_m + neck)
    matte = np.zeros((320, 320), np.uint8)
    for triangle in np.round(px[person.faces] * 8).astype(np.int32):
        cv2.fillConvexPoly(matte, triangle, (1,), shift=3)
    lines = [shoulder_line(k, matte.astype(np.float32), neck, CAMERA) for k in range(6)]
    rotation = np.tile(np.eye(3), (6, 1, 1))
    assert shoulders_up_cm(body, CAMERA, lines, rotation) == pytest.approx(told_cm, abs=0.35)


def test_what_was_seen_of_a_body_comes_back_and_damage_is_told(tmp_path: Path) -> None:
    none, drawn = np.zeros((0, 2)), np.random.default_rng(5)
    chosen, certain = drawn.uniform(0, 99, (9, 2)), np.tile(np.eye(2), (9, 1, 1))
    seen = [
        BodySighting(0, none, chosen, certain, np.nan),
        BodySighting(0, chosen + 1, None, None, 0.5),
        BodySighting(1, none, none, np.zeros((0, 2, 2)), np.nan),
    ]
    shoulders = [SeenShoulders(1, drawn.uniform(0, 99, (2, 2)), 0.1)]
    patches = [OutlinePatch(2, drawn.integers(0, 256, (4, 6)).astype(np.uint8))]
    lines = [ShoulderLine(0, np.array([1.0, np.nan, 2.0]))]
    shown = [BodyShown(0, 800.0, 0.01)]
    path = tmp_path / "body.npz"
    BodyBlock(seen, shoulders, patches, lines, shown, FollowerState.before_the_first()).save(path)
    back = BodyBlock.load(path)
    assert [one.run for one in back.sightings] == [0, 0, 1]
    assert [one.chosen_px is None for one in back.sightings] == [False, True, False]
    np.testing.assert_array_equal(back.sightings[1].seen_px, seen[1].seen_px)
    np.testing.assert_array_equal(back.shoulders[0].shoulders_px, shoulders[0].shoulders_px)
    assert [one.position for one in back.patches] == [2]
    np.testing.assert_array_equal(back.patches[0].alpha, patches[0].alpha)
    np.testing.assert_array_equal(back.lines[0].above_cm, lines[0].above_cm)
    assert back.shown == shown
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(UserError, match=r"no body that was seen.*same command again"):
        BodyBlock.load(path)


def test_hair_beside_the_neck_or_a_picture_without_shoulders_raises_nothing() -> None:
    body = BodyMesh.of(HeadModel.embedded(torch.float64, EMBEDDED_BUST), np.zeros(32))
    neck, rotation = np.array([0.0, -0.05, 0.0]), np.eye(3)[None]
    everything = np.ones((320, 320), np.float32)
    for matte in (everything, np.zeros_like(everything)):
        line = shoulder_line(0, matte, neck, CAMERA)
        assert np.isnan(line.above_cm).all()
        assert shoulders_up_cm(body, CAMERA, [line], rotation) == 0.0
