"""The person's outline in the fit: what it asks for, what it leaves alone, and what it survives."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.drawing.wireframe import mesh_silhouette
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.clip import ClipLandmarks
from rgbavatar_ns.tracking.face.detector import FACE_OVAL
from rgbavatar_ns.tracking.face.iris import FoundIrises
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.outline import OutlineCost, OutlineTerms, PersonOutline
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.image.crop import SquareCrop
from rgbavatar_ns.tracking.image.outlines import OUTLINE_PX, key_outlines, person_outline
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.resumable_run import ResumableRun

from .acting import CAMERA, observed, performance

CROP = SquareCrop(left=10, top=-50, side=300, size=OUTLINE_PX)
COMPONENTS = 12
HAIR_M = 0.01
UPRIGHT = np.eye(2)
Alter = Callable[[np.ndarray], np.ndarray]


def silhouette(head: HeadModel, theta: np.ndarray, identity: np.ndarray) -> np.ndarray:
    """The head in the crop, as a mask of bytes."""
    with torch.no_grad():
        vertices = head(torch.from_numpy(theta), torch.from_numpy(identity)).numpy()
    points = CROP.points(CAMERA.project(vertices))
    mask = mesh_silhouette(points, head.arrays.faces, OUTLINE_PX)
    return (mask * 255).astype(np.uint8)


def haired(mask: np.ndarray) -> np.ndarray:
    """Grown by hair all around."""
    radius = round(HAIR_M * CAMERA.focal_px / CAMERA.distance_m * CROP.scale)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(mask, disc))


def seen_faces(head: HeadModel, theta: np.ndarray, identity: np.ndarray) -> np.ndarray:
    """Landmarks of each frame; those that the tracker does not use lie in the face's middle."""
    tracker = SubjectTracker(head, TrackConfig())
    points = observed(tracker, theta, identity)
    unused = np.setdiff1d(np.arange(points.shape[1]), tracker.facemesh_index)
    points[:, unused] = points[:, tracker.facemesh_index].mean(1, keepdims=True)
    return points


class Scene:
    """A person whose landmarks tell too high a forehead, and what fits make of it."""

    def __init__(self, head: HeadModel) -> None:
        self.head = head
        self.theta, self.identity = performance(head, 4)
        self.landmarks = seen_faces(head, self.theta, self.identity)
        self.true = [silhouette(head, row, self.identity) for row in self.theta]
        # Every point of the face's outline above the brows, up by a seventh of the face's height.
        brows = self.landmarks[:, 105, 1]
        for index in FACE_OVAL:
            high = (brows - self.landmarks[:, index, 1]).clip(0)
            self.landmarks[:, index, 1] -= 0.5 * high

    def tracker(self) -> SubjectTracker:
        options = TrackConfig(
            focal_px=CAMERA.focal_px, key_frames=4, identity_components=COMPONENTS
        )
        return SubjectTracker(self.head, options)

    def fit(self, alter: Alter | None) -> tuple[SubjectTracker, ClipFit]:
        """From landmarks alone (None), or with the true outlines in their hair, altered."""
        tracker, outlines = self.tracker(), []
        if alter is not None:
            mattes = [alter(haired(mask)) for mask in self.true]
            outlines = [person_outline(m, CROP, p) for m, p in zip(mattes, self.landmarks)]
        follows = [False, True, True, True]
        return tracker, tracker.fit(self.landmarks, follows, 320, 240, outlines=outlines)

    def crown_mm(self, fitted: tuple[SubjectTracker, ClipFit]) -> float:
        """How much too high the fitted crown lies, over the eyes; mean over frames."""
        tracker, fit = fitted
        with torch.no_grad():
            ours = self.head(
                torch.from_numpy(tracker.thetas(fit)), torch.from_numpy(fit.subject.identity)
            ).numpy()
            real = self.head(torch.from_numpy(self.theta), torch.from_numpy(self.identity)).numpy()
        eyes = self.head.arrays.vertex_groups["left_eye"]
        tall = [points[..., 1].max(1) - points[:, eyes, 1].mean(1) for points in (ours, real)]
        return float(1e3 * (tall[0] - tall[1]).mean())


@pytest.fixture(scope="module")
def scene(head: HeadModel) -> Scene:
    return Scene(head)


@pytest.fixture(scope="module")
def landmarks_alone(scene: Scene) -> tuple[SubjectTracker, ClipFit]:
    return scene.fit(None)


def test_distances_of_a_plane_are_exact_and_the_border_goes_on() -> None:
    rows, columns = np.mgrid[:6, :9].astype(np.float64)
    outline = PersonOutline(3 * columns - 2 * rows, np.array([10.0, 20.0]), 0.5)
    away, slope = outline.at(np.array([[11.3, 20.7], [14.0, 22.5], [99.0, 20.2]]))
    np.testing.assert_allclose(away, [3 * 2.6 - 2 * 1.4, 3 * 8 - 2 * 5, 3 * 8 - 2 * 0.4])
    np.testing.assert_allclose(slope, [[6, -4], [6, -4], [0, -4]])


@pytest.mark.parametrize("hair_m", [None, 0.015])
def test_the_outlines_gradient_is_the_costs_own(head: HeadModel, hair_m: float | None) -> None:
    theta, identity = performance(head, 2)
    tracker = SubjectTracker(head, TrackConfig())
    columns = tracker.cost.parameters.columns
    cost = OutlineCost(head, columns, COMPONENTS)
    # A circle, whose distance is smooth, smaller than the head.
    rows, column = np.mgrid[:240, :320] + 0.5
    away = np.hypot(column - 160, rows - 110) - 70
    terms = OutlineTerms(PersonOutline(away, np.array([0.5, 0.5]), 1.0), CAMERA, UPRIGHT, hair_m)
    model = cost.at(theta[1], identity, terms).model()
    assert model.cost == pytest.approx(cost.at(theta[1], identity, terms).cost)
    step = 1e-6
    for place, column in enumerate(columns[:8]):
        there, here = theta[1].copy(), theta[1].copy()
        there[column] += step
        here[column] -= step
        values = [cost.at(one, identity, terms).cost for one in (there, here)]
        slope = (values[0] - values[1]) / (2 * step)
        # Between the field's samples the slope jumps, and the outermost points may change.
        assert model.gradient[place] == pytest.approx(slope, rel=0.03, abs=5)
    for place in range(COMPONENTS):
        there, here = identity.copy(), identity.copy()
        there[place] += step
        here[place] -= step
        values = [cost.at(theta[1], one, terms).cost for one in (there, here)]
        slope = (values[0] - values[1]) / (2 * step)
        assert model.gradient[len(columns) + place] == pytest.approx(slope, rel=0.05, abs=1)


def test_only_what_stands_out_costs(head: HeadModel) -> None:
    theta, identity = performance(head, 1)
    cost = OutlineCost(head, np.arange(3), 0)
    wide = person_outline(haired(silhouette(head, theta[0], identity)), CROP, _face(head))
    assert wide is not None
    terms = OutlineTerms(wide, CAMERA, UPRIGHT)
    assert cost.at(theta[0], identity, terms).cost == 0
    assert cost.hair_m([theta[0]], identity, [terms]) == pytest.approx(HAIR_M, abs=0.002)
    up = theta[0].copy()
    up[head.layout.slice("translation").start + 1] += 2 * HAIR_M
    assert cost.at(up, identity, terms).cost > 1


def test_a_skull_that_landmarks_put_too_high_comes_down_into_the_outline(
    scene: Scene, landmarks_alone: tuple[SubjectTracker, ClipFit]
) -> None:
    before, after = scene.crown_mm(landmarks_alone), scene.crown_mm(scene.fit(lambda matte: matte))
    assert before > 6, "landmarks alone believe what they are told"
    assert abs(after) < before / 2


def _without_hat(matte: np.ndarray) -> np.ndarray:
    """Nothing left of what is more than a few centimetres above the brows."""
    top = int(np.flatnonzero(matte.any(1))[0])
    return np.where(np.arange(len(matte))[:, None] < top + 60, 0, matte).astype(np.uint8)


def _with_hand(matte: np.ndarray) -> np.ndarray:
    rows, columns = np.mgrid[: len(matte), : len(matte)]
    return np.where(np.hypot(rows - 60, columns - 190) < 45, 255, matte).astype(np.uint8)


def _cropped(matte: np.ndarray) -> np.ndarray:
    """The frame ends within the head: what its border shows goes on."""
    first = int(np.flatnonzero(matte.any(1))[0]) + 25
    return np.where(np.arange(len(matte))[:, None] < first, matte[first], matte).astype(np.uint8)


@pytest.mark.parametrize("alter", [_without_hat, _with_hand, _cropped])
def test_a_hat_left_out_a_hand_or_the_frames_border_do_no_harm(
    scene: Scene, landmarks_alone: tuple[SubjectTracker, ClipFit], alter: Alter
) -> None:
    before, after = scene.crown_mm(landmarks_alone), scene.crown_mm(scene.fit(alter))
    assert -8 < after < before + 4


def test_without_outlines_the_fit_is_as_from_landmarks(
    scene: Scene, landmarks_alone: tuple[SubjectTracker, ClipFit]
) -> None:
    _, hopeless = scene.fit(np.zeros_like)
    np.testing.assert_array_equal(hopeless.values, landmarks_alone[1].values)


def _face(head: HeadModel) -> np.ndarray:
    theta, identity = performance(head, 1)
    return seen_faces(head, theta, identity)[0]


def test_holes_are_filled_and_what_stands_apart_is_left_out() -> None:
    crop = SquareCrop(0, 0, 100, 100)
    points = np.random.default_rng(0).uniform(45, 55, (478, 2))
    matte = np.zeros((100, 100), np.uint8)
    matte[20:80, 30:70] = 255
    whole = person_outline(matte, crop, points)
    assert whole is not None
    # The edge lies between pixels 19 and 20: at 20; inside it is 30 from the middle's left edge.
    away, _ = whole.at(np.array([[50.0, 20.0], [50.0, 10.5], [50.5, 60.5]]))
    np.testing.assert_allclose(away, [0, 9.5, -19.5])
    matte[44:50, 40:60], matte[5:15, 80:95] = 0, 255
    altered = person_outline(matte, crop, points)
    assert altered is not None
    np.testing.assert_array_equal(altered.outside_px, whole.outside_px)


def test_damaged_mattes_of_key_frames_are_told(
    clip_of_key_frames: tuple[FrameSource, ClipLandmarks], tmp_path: Path
) -> None:
    source, found = clip_of_key_frames
    first = ResumableRun(tmp_path)
    first.folder.mkdir()
    assert key_outlines(source, None, True, found, [1], first) == [None], "all is opaque"
    kept = first.folder / "key_mattes.npz"
    kept.write_bytes(kept.read_bytes()[:-40])
    with pytest.raises(UserError, match="no mattes of key frames"):
        key_outlines(source, None, True, found, [1], ResumableRun(tmp_path))


@pytest.fixture
def clip_of_key_frames(tmp_path: Path) -> tuple[FrameSource, ClipLandmarks]:
    """Two frames without a matte of their own, and where a face would be."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in range(2):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((48, 64, 3), 90, np.uint8))
    points = np.random.default_rng(1).uniform(20, 40, (2, 478, 2))
    found = ClipLandmarks(
        points, FoundIrises.unseen(points), (0, 1), (0, 0), (0, 0), 2, 64, 48, (), ()
    )
    return FrameSource.open(folder), found


def test_a_matte_that_misses_the_face_or_holds_everything_is_no_evidence() -> None:
    crop = SquareCrop(0, 0, 100, 100)
    points = np.random.default_rng(0).uniform(30, 70, (478, 2))
    half = np.zeros((100, 100), np.uint8)
    half[:, :45] = 255
    for matte in (half, np.zeros_like(half), np.full_like(half, 255)):
        assert person_outline(matte, crop, points) is None
