"""Irises found in pictures of eyes whose iris is known, and none where none can be seen."""

from collections.abc import Callable
from contextlib import closing

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson
from rgbavatar_ns.synthetic.performer.performance import perform
from rgbavatar_ns.tracking.face.detector import (
    EYE_CORNERS,
    IRIS_CENTERS,
    IRIS_RIMS,
    LID_PAIRS,
    FaceLandmarker,
)
from rgbavatar_ns.tracking.face.drawn_eye import ALONG, BELOW, PARAMETERS, SHAPE, drawn_eye
from rgbavatar_ns.tracking.face.iris import FoundIrises, find_irises
from rgbavatar_ns.tracking.fit.irises import iris_places
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead

FINE = 4
"""Subpixels a pixel, along each axis, that the tests' eyes are drawn with."""
BROWN, BLUE, DARK_SKIN, SKIN = (70, 45, 30), (90, 130, 150), (120, 80, 60), (215, 170, 145)


class Eyes:
    """Both eyes of a face, drawn in colours, with lids that are no parabolas; FaceMesh's points on
    them, of which irises stand off by up to .05 eye widths and lids by .02."""

    def __init__(
        self,
        width_px: float,
        seed: int,
        iris: tuple[int, int, int] = BLUE,
        skin: tuple[int, int, int] = SKIN,
        light: float = 1.0,
        opening: float = 1.0,
    ) -> None:
        random = np.random.default_rng(seed)
        self.size = np.ceil(np.array([5.0, 2.2]) * width_px).astype(int)
        middles = np.array([[1.4, 1.1], [3.6, 1.1]]) * width_px + random.uniform(-1, 1, (2, 2))
        gaze = random.uniform([-0.14, -0.06], [0.14, 0.05])
        self.irises_px = middles + gaze * width_px
        rows, columns = np.mgrid[: self.size[1] * FINE, : self.size[0] * FINE]
        place = (np.stack([columns, rows], -1) + 0.5) / FINE
        fine = np.empty((*rows.shape, 3))
        fine[:] = skin
        self.points = np.zeros((478, 2))
        for eye in range(2):
            x, y = np.moveaxis((place - middles[eye]) / width_px, -1, 0)
            course = np.cos(np.pi * x.clip(-0.5, 0.5))
            upper, lower = -0.2 * opening * course, 0.11 * opening * course**0.7
            within = (y > upper) & (y < lower)
            away = np.hypot(*np.moveaxis((place - self.irises_px[eye]) / width_px, -1, 0))
            shade = (1 - 0.3 * np.abs(x))[..., None]
            shown = np.where(away[..., None] < 0.195, iris, np.array([225.0, 215, 210]) * shade)
            shown = np.where(away[..., None] < 0.07, 15, shown)
            fine = np.where(within[..., None], shown, fine)
            fine[np.abs(y - upper) < 0.015 + (np.abs(x) > 0.5)] *= 0.8
            self._mark(eye, middles[eye], width_px, opening, random)
        shrunk = fine.reshape(self.size[1], FINE, self.size[0], FINE, 3).mean((1, 3))
        noise = random.normal(0, 2, shrunk.shape)
        self.image = (light * shrunk + noise).clip(0, 255).round().astype(np.uint8)

    def _mark(
        self,
        eye: int,
        middle: np.ndarray,
        width_px: float,
        opening: float,
        random: np.random.Generator,
    ) -> None:
        corners = np.array([[-0.5, 0.0], [0.5, 0.0]])
        self.points[list(EYE_CORNERS[eye])] = middle + width_px * corners
        for along, (upper, lower) in zip((0.0, 0.2, -0.2), LID_PAIRS[3 * eye : 3 * eye + 3]):
            course, off = np.cos(np.pi * along), random.uniform(-0.02, 0.02, 2)
            self.points[upper] = middle + width_px * np.array([along, -0.2 * opening * course])
            self.points[lower] = middle + width_px * np.array([along, 0.11 * opening * course])
            self.points[[upper, lower], 1] += width_px * off * opening
        guess = self.irises_px[eye] + width_px * random.uniform(-0.05, 0.05, 2)
        self.points[IRIS_CENTERS[eye]] = guess
        ring = 0.195 / 1.1 * width_px * np.array([[1, 0], [0, -1], [-1, 0], [0, 1]])
        self.points[list(IRIS_RIMS[eye])] = guess + ring

    def found(self) -> FoundIrises:
        return find_irises(self.image, self.points)


@pytest.mark.parametrize("width_px", [20.0, 34.0, 60.0])
@pytest.mark.parametrize(("iris", "light"), [(BLUE, 1.0), (BROWN, 1.0), (BROWN, 0.35)])
def test_irises_are_found_to_a_fraction_of_a_pixel(
    width_px: float, iris: tuple[int, int, int], light: float
) -> None:
    off = []
    for seed in range(4):
        skin = DARK_SKIN if seed % 2 else SKIN
        eyes = Eyes(width_px, seed, iris, skin, light)
        found = eyes.found()
        assert found.found.all()
        off.append((found.centers - eyes.irises_px) / max(1.0, width_px / 34))
    assert np.sqrt(np.square(off).mean()) < 0.3, "pixels; of large eyes samples"


def _shut(eyes: Eyes) -> np.ndarray:
    eyes.points[[k for _, k in LID_PAIRS]] = eyes.points[[k for k, _ in LID_PAIRS]] + (0, 1)
    return eyes.image


def _blurred(eyes: Eyes) -> np.ndarray:
    return cv2.GaussianBlur(eyes.image, (0, 0), 12)


def _behind_a_hand(eyes: Eyes) -> np.ndarray:
    return np.full_like(eyes.image, 1) * np.array(SKIN, np.uint8)


def _out_of_the_picture(eyes: Eyes) -> np.ndarray:
    eyes.points[:, 1] += 500
    return eyes.image


def _behind_a_reflection(eyes: Eyes) -> np.ndarray:
    return (235 + 0.02 * eyes.image).astype(np.uint8)


@pytest.mark.parametrize(
    "hidden", [_shut, _blurred, _behind_a_hand, _out_of_the_picture, _behind_a_reflection]
)
def test_where_no_iris_can_be_seen_none_is(hidden: Callable[[Eyes], np.ndarray]) -> None:
    for seed in range(3):
        eyes = Eyes(30.0, seed)
        guessed = eyes.points[list(IRIS_CENTERS)].copy()
        assert eyes.found().found.all()
        eyes.image = hidden(eyes)
        found = eyes.found()
        assert not found.found.any()
        assert np.isinf(found.sigma).all()
        if hidden is not _out_of_the_picture:
            np.testing.assert_array_equal(found.centers, guessed, "FaceMesh's guess stays")


def test_a_highlight_on_the_limbus_moves_nothing() -> None:
    eyes = Eyes(40.0, 1)
    before = eyes.found()
    for x, y in eyes.irises_px + np.array([6.0, -2.0]):
        cv2.circle(eyes.image, (int(x), int(y)), 2, (255, 255, 255), -1)
    after = eyes.found()
    assert np.abs(after.centers - before.centers).max() < 0.4


def test_each_iris_is_less_sure_up_and_down_than_sideways() -> None:
    sigma = np.array([Eyes(30.0, seed).found().sigma for seed in range(4)])
    assert (sigma[..., 1] > sigma[..., 0]).mean() > 0.8, "lids hide the limbus's top"


def test_a_picture_moved_by_whole_pixels_moves_irises_alike() -> None:
    eyes = Eyes(30.0, 2)
    before = eyes.found()
    eyes.image = cv2.copyMakeBorder(eyes.image, 7, 0, 11, 0, cv2.BORDER_REPLICATE)
    eyes.points += (11, 7)
    np.testing.assert_allclose(eyes.found().centers, before.centers + np.array([11, 7]), atol=1e-4)


def test_the_drawn_eyes_derivatives_are_its_slopes() -> None:
    random = np.random.default_rng(0)
    eye = np.array([[0.05, -0.02, np.log(0.2), 0.9, -0.2, 0.1, 0.12, -0.05]])
    colours = np.array([[180.0, 200, 220, 200, 90, -40, -20, 15]]) + random.normal(0, 5, (1, 8))
    eye, soft = np.concatenate([eye, colours], axis=1), np.array([0.03])
    _, slopes = drawn_eye(eye, soft)
    for place in range(PARAMETERS):
        is_shape = place < SHAPE.stop
        step, tolerance = (1e-5, 2.0) if is_shape else (1e-2, 1e-6)  # of hundreds of levels
        ends = [eye + sign * step * np.eye(PARAMETERS)[place] for sign in (1, -1)]
        slope = np.subtract(*(drawn_eye(end, soft)[0] for end in ends))[0] / (2 * step)
        # Where one sclera goes over into the other counts as fixed: it is behind the iris.
        beside = np.hypot(ALONG - eye[0, 0], BELOW - eye[0, 1])[0] > (0.0 if place > 2 else 0.45)
        np.testing.assert_allclose(slopes[0, place, beside], slope[beside], atol=tolerance)


def test_the_irises_of_a_procedural_person_are_nearer_than_facemeshs() -> None:
    pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
    config = DemoConfig(num_frames=40, num_test_frames=10, seed=40, glasses=False, supersampling=1)
    person = DemoPerson.of(config)
    layout, names = person.head.layout, person.head.arrays.expression_names
    theta = perform(layout, names, 40, 10, 12.0, 40)[::8]
    blink = layout.slice("expression").start + names.index("eyeBlinkLeft")
    theta = theta[theta[:, blink] < 0.2]
    camera, irises = person.camera, LandmarkHead(person.head, *iris_places(person.head.arrays))
    away = np.array([irises.points(row, person.identity.double().numpy()) for row in theta])
    away = away - (0.0, camera.height_m, camera.distance_m)
    true_px = away[..., :2] * (1, -1) * camera.focal_px / -away[..., 2:] + camera.size / 2
    guessed, found = [], []
    with closing(FaceLandmarker()) as landmarker:
        for image in person.draw(torch.from_numpy(theta).float()):
            picture = np.ascontiguousarray(image[..., :3])
            landmarker(picture)  # the next look begins where this one found the face
            points = landmarker(picture)
            assert points is not None
            guessed.append(points[list(IRIS_CENTERS)])
            found.append(find_irises(picture, points))
    seen = FoundIrises.stacked(found)
    assert seen.found.mean() > 0.7
    errors = [
        np.linalg.norm((centers - true_px)[seen.found], axis=-1)
        for centers in (np.array(guessed), seen.centers)
    ]
    assert np.median(errors[1]) < 0.4, "pixels of eyes 20 pixels wide"
    assert np.median(errors[1]) < 0.7 * np.median(errors[0])
