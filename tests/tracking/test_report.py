"""The figures and words of the report, worked by hand."""

from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from rgbavatar_ns.cli.track import summary_table
from rgbavatar_ns.data.check.problems import verdict
from rgbavatar_ns.drawing.wireframe import mesh_silhouette
from rgbavatar_ns.tracking.face.detector import LIP_PAIRS, face_height_px
from rgbavatar_ns.tracking.image.head_mask import HeadOutline, height_above_chin
from rgbavatar_ns.tracking.verify.contact_sheet import draw_tile, sheet_frames
from rgbavatar_ns.tracking.verify.report import (
    closed_eyes,
    count_blinks,
    gap_correlation,
    gap_shares,
    silhouette_shares,
    silhouette_summary,
    tracking_findings,
)

GOOD: dict[str, Any] = {
    "frames_read": 200,
    "frames_tracked": 200,
    "rejected": {"no face": []},
    "segments": [{"clip": 0}],
    "other_faces": [],
    "blurred": [],
    "notes": [],
    "reprojection_error_share": 0.004,
    "worst_frame_error_share": 0.01,
    "mesh_reprojection_error_share": 0.009,
    "mouth_opening_correlation": 0.98,
    "eyelid_opening_correlation": 0.95,
    "blinks_fitted": 3,
    "blinks_measured": 3,
    "iris_error_eye_widths": 0.05,
    "worst_iris_error_eye_widths": 0.1,
    "gaze_at_bound_share": 0.0,
    "silhouette_coverage": 0.99,
    "mesh_outside_matte": 0.01,
    "matte_misses": 0.0,
    "face_silhouette_iou": 0.92,
    "face_height_px": 180.0,
    "stages": {"faces": {"frames": 200, "seconds": 8.0, "frames_per_second": 25.0}},
    "frames_per_second": 12.0,
    "body": None,
}


def test_blinks_are_counted_once_each() -> None:
    gap = np.array([10, 10, 3, 2, 9, 10, 1, 10, 6, 10, 10, 2.0])
    assert closed_eyes(gap).tolist() == [k in (2, 3, 6, 11) for k in range(12)]
    assert count_blinks(gap) == 3
    assert count_blinks(np.full(5, 7.0)) == 0


def test_correlation_of_openings() -> None:
    opening = np.array([1.0, 2, 3, 2])
    assert gap_correlation(2 * opening + 1, opening) == pytest.approx(1)
    assert gap_correlation(-opening, opening) == pytest.approx(-1)
    assert gap_correlation(np.ones(4), opening) is None
    # As lids that never blink: what trembles is no motion that a fit could follow.
    assert gap_correlation(opening, 0.05 + 0.009 * opening) is None
    assert gap_correlation(opening, 0.05 + 0.02 * opening) == pytest.approx(1)


def test_a_face_that_comes_nearer_opens_no_mouth() -> None:
    """A fit whose mouth keeps still follows none that speaks, however large the face becomes."""
    drawn, height = np.random.default_rng(7), np.linspace(120, 300, 80)
    still, speaks = 0.15 + 0.012 * drawn.standard_normal((2, 80))
    faces = []
    for opening in (still, speaks):
        points = np.zeros((80, 478, 2))
        points[:, 152, 1] = height
        points[:, [below for _, below in LIP_PAIRS], 1] = (opening * height)[:, None]
        faces.append(points)
    every = np.arange(478)
    shares = [gap_shares(points, every, LIP_PAIRS, face_height_px(points)) for points in faces]
    np.testing.assert_allclose(shares, [still, speaks])
    correlation = gap_correlation(*shares)
    assert correlation == pytest.approx(np.corrcoef(still, speaks)[0, 1])
    assert abs(correlation) < 0.3 < 0.85 < np.corrcoef(still * height, speaks * height)[0, 1]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "good"),
        ({"background": "moves"}, "usable: the camera moves"),
        ({"body": {"background_moves_px": 20.0}}, "usable: the camera moves"),
        ({"body": {"background_moves_px": 2.0}}, "good"),
        (
            {
                "background": "moves",
                "body": {"background_moves_px": 0.2, "background_stands": True},
            },
            "usable: something moves behind the person",
        ),
        (
            {
                "background": "moves",
                "body": {"background_moves_px": 0.2, "background_stands": True},
                "segments": [{"clip": 0}, {"clip": 1}],
            },
            "usable: the clips show other rooms, or from another place, or something moves in them",
        ),
        (
            {"background": "moves", "body": {"background_moves_px": 2.0}},
            "usable: the camera moves",
        ),
        ({"body": {"background_moves_px": None}}, "good"),
        (
            {"body": {"seen_cm2": 0.0}},
            "usable: no body is in the picture: it is taken to keep still",
        ),
        (
            {"body": {"seen_cm2": 40.0, "covered_share": 0.5}},
            "usable: the body is hardly seen",
        ),
        (
            {"body": {"seen_cm2": 700.0, "covered_share": 0.2, "beside_share": 0.0}},
            "usable: something is before the body in 20% of frames (an arm, a hand)",
        ),
        (
            {"body": {"seen_cm2": 700.0, "covered_share": 0.0, "beside_share": 0.12}},
            "usable: beside the person there is somebody, or a chair, in 12% of frames",
        ),
        ({"body": {"seen_cm2": 700.0, "covered_share": 0.02, "beside_share": 0.05}}, "good"),
        ({"mouth_opening_correlation": None, "eyelid_opening_correlation": None}, "good"),
        ({"mesh_reprojection_error_share": 0.02}, "usable: the mesh lies off the face"),
        ({"mesh_reprojection_error_share": 0.05}, "look at it: the mesh lies off the face"),
        ({"frames_tracked": 180}, "usable: 20 of 200 frames are left out"),
        ({"frames_tracked": 100}, "look at it: 100 of 200 frames are left out"),
        ({"eyelid_opening_correlation": 0.7}, "usable: the eyelids are not followed"),
        ({"iris_error_eye_widths": 0.15}, "usable: the irises lie off the film's"),
        ({"iris_error_eye_widths": None}, "good"),
        ({"gaze_at_bound_share": 0.3}, "look at it: the gaze is at its bounds in 30% of frames"),
        (
            {"silhouette_coverage": 0.5, "mesh_outside_matte": 0.1, "matte_misses": 0.4},
            "look at it: the matte misses part of the head",
        ),
        (
            {"silhouette_coverage": 0.9, "mesh_outside_matte": 0.09, "matte_misses": 0.01},
            "usable: the mesh stands out of the person's outline",
        ),
        ({"other_faces": [4, 5]}, "look at it: another face is seen in 2 frames"),
        ({"face_height_px": 40.0}, "look at it: the face is only 40 pixels high"),
        ({"blurred": list(range(30))}, "usable: 30 frames are blurred"),
        # Grave words come before mild ones.
        (
            {
                "mesh_reprojection_error_share": 0.02,
                "silhouette_coverage": 0.5,
                "mesh_outside_matte": 0.1,
                "matte_misses": 0.4,
            },
            "look at it: the matte misses part of the head; the mesh lies off the face",
        ),
    ],
)
def test_the_verdict_says_what_is_amiss(changes: dict[str, Any], words: str) -> None:
    assert verdict(tracking_findings(GOOD | changes)) == words


def test_the_table_names_every_figure() -> None:
    console = Console(width=200, record=True)
    console.print(summary_table(GOOD | {"verdict": "good", "frames_per_second": None}))
    text = console.export_text()
    for part in ("200 of 200", "0.90 %", "0.40 %", "0.980", "0.950", "99.00 %", "25 frames/s"):
        assert part in text
    assert "None" not in text


def test_silhouettes_compared_by_hand() -> None:
    # Rows 0 to 99, chin at row 80, forehead at row 0: above_chin falls from 1 to -.25.
    above = height_above_chin(np.array([50.0, 0.0]), np.array([50.0, 80.0]), 100)
    assert above[0, 0] == pytest.approx(1 - 0.5 / 80)
    mesh, seen = np.zeros((100, 100), np.float32), np.ones((100, 100), np.float32)
    mesh[10:95, 30:70] = 1
    outline = HeadOutline(mesh, above, 80.0, None)
    hair, wider, half = mesh.copy(), mesh.copy(), mesh.copy()
    hair[:30, 20:80] = 1
    with_hair = silhouette_shares(outline, hair, seen)
    assert with_hair == {"coverage": 1, "outside": 0, "missed": 0, "face_iou": 1}, (
        "hair on top costs nothing"
    )
    wider[:, 65:75] = 1
    assert silhouette_shares(outline, wider, seen)["face_iou"] == pytest.approx(40 / 45)
    half[:, :50] = 0
    halved = silhouette_shares(outline, half, seen)
    # Above the chin 70 rows of 40: of the lost 20 columns 8 rows on top and 8 columns are rim.
    missed = 62 * 12 / (70 * 40)
    expected = {"coverage": 0.5, "outside": 0.5 - missed, "missed": missed, "face_iou": 0.5}
    assert halved == pytest.approx(expected)
    outside = silhouette_shares(outline, half, 0 * seen)
    assert set(outside.values()) == {None}
    summary = silhouette_summary([halved, outside, with_hair])
    assert summary["silhouette_coverage"] == pytest.approx(0.75)
    assert summary["worst_silhouette_coverage"] == pytest.approx(0.5)


def test_a_mesh_that_stands_out_and_a_matte_with_a_hole_are_told_apart() -> None:
    above = height_above_chin(np.array([50.0, 0.0]), np.array([50.0, 80.0]), 100)
    mesh, seen = np.zeros((100, 100), np.float32), np.ones((100, 100), np.float32)
    mesh[10:95, 30:70] = 1
    outline = HeadOutline(mesh, above, 80.0, None)
    lower, hole = mesh.copy(), mesh.copy()
    lower[:16] = 0
    hole[40:46, 40:60] = 0
    for matte, name, lost in ((lower, "outside", 6 * 40), (hole, "missed", 6 * 20)):
        shares = silhouette_shares(outline, matte, seen)
        other = "missed" if name == "outside" else "outside"
        assert shares[name] == pytest.approx(lost / (70 * 40))
        assert shares[other] == 0
        assert shares["coverage"] == pytest.approx(1 - lost / (70 * 40))


def test_a_silhouette_is_the_pixels_whose_centres_lie_inside() -> None:
    random = np.random.default_rng(4)
    points = random.uniform(-8, 72, (30, 2))
    faces = np.array([random.choice(30, 3, replace=False) for _ in range(25)])
    mask = mesh_silhouette(points, faces, 64)
    expected = np.zeros((64, 64))
    for a, b, c in points[faces]:
        if (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) >= 0:
            continue
        contour = np.array([a, b, c], np.float32)
        for row in range(64):
            for column in range(64):
                if not expected[row, column]:
                    center = (column + 0.5, row + 0.5)
                    expected[row, column] = cv2.pointPolygonTest(contour, center, False) >= 0
    assert np.abs(mask - expected).sum() <= 2, "but for centres on an edge"
    assert expected.sum() > 300


def _landmarks(frames: int) -> np.ndarray:
    points = np.random.default_rng(5).uniform(100, 200, (478, 2))
    outline = [(150, 50), (150, 250), (80, 150), (220, 150), (150, 150)]
    points[[10, 152, 234, 454, 4]] = outline
    return np.repeat(points[None], frames, axis=0)


def test_the_sheet_shows_the_frames_that_are_most_likely_wrong() -> None:
    points = _landmarks(200)
    points[37, 14] = points[37, 13] + (0, 900)
    points[61, 4] += (30, 0)
    error = np.ones(200)
    error[113] = 9
    shown = sheet_frames(points, error)
    assert list(shown) == sorted(shown)
    assert len(shown) == 12
    assert "widest mouth" in shown[37]
    assert "worst fit" in shown[113]
    assert "turned left" in shown[61]
    assert max(np.diff(list(shown))) < 45, "the rest lies evenly between"


def test_a_sheet_of_one_frame() -> None:
    shown = sheet_frames(_landmarks(1), np.ones(1))
    assert list(shown) == [0]
    image = np.full((64, 64, 4), 255, np.uint8)
    corners = np.array([[10.0, 10], [50, 10], [30, 50]])
    sheet = draw_tile(shown[0], image, corners, np.array([[0, 2, 1]]), corners, corners + 3)
    assert sheet.shape[1] == 2 * sheet.shape[0]
    assert sheet[:, : sheet.shape[0]][40:].min() == 255, "left: the image as it is"
    assert sheet[:, sheet.shape[0] :].min() < 200, "right: with the mesh"


@pytest.mark.parametrize(
    ("followed", "outlined", "still", "told"),
    [
        (0.9, 0.2, True, "keeps still"),
        (0.0, 0.0, True, "taken to keep still: neither pattern nor outline"),
        (0.1, 0.8, True, "keeps still, mostly by its outline"),
        (0.1, 0.8, False, "turns by 2 degrees, moves by 3 cm, mostly by its outline"),
        (0.9, 0.2, False, "turns by 2 degrees, moves by 3 cm"),
    ],
)
def test_the_table_says_by_what_a_body_was_followed(
    followed: float, outlined: float, still: bool, told: str
) -> None:
    body = {"followed_share": followed, "outlined_share": outlined, "still": still}
    body |= {"turned_degrees": 2.2, "moved_mm": 31.0}
    console = Console(width=200, record=True)
    report = GOOD | {"verdict": "good", "frames_per_second": None, "body": body}
    console.print(summary_table(report))
    assert told in console.export_text()
