"""A filmed body ends at the same place of itself in every frame, wherever the picture ends."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rgbavatar_ns.drawing.wireframe import mesh_silhouette
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.arrays import EMBEDDED_BUST
from rgbavatar_ns.tracking.image.body_end import BodyEnd
from rgbavatar_ns.tracking.image.cut_out import CutOut, MattedCrop
from rgbavatar_ns.tracking.image.head_mask import HeadMask

SIZE, FOCAL_PX = 256, 500.0
FADE_ROWS = 10
"""Four hundredths of the picture."""


@pytest.fixture(scope="module")
def bust() -> HeadArrays:
    return HeadArrays.embedded(EMBEDDED_BUST)


def seen_px(bust: HeadArrays, up_m: float = 0.0, turn_degrees: tuple = (0, 0, 0)) -> np.ndarray:
    """The mesh before a pinhole a metre away, leaning about the neck's foot."""
    rest = np.asarray(bust.v_template, np.float64)
    foot = np.array([0.0, -0.11, -0.08])
    turn = Rotation.from_euler("xyz", turn_degrees, degrees=True).as_matrix()
    placed = (rest - foot) @ turn.T + foot + [0, up_m, 0]
    x, y, depth = placed[:, 0], placed[:, 1], 1.0 - placed[:, 2]
    return np.stack([SIZE / 2 + FOCAL_PX * x / depth, SIZE / 2 - FOCAL_PX * y / depth], axis=1)


def everywhere() -> np.ndarray:
    return np.ones((SIZE, SIZE), bool)


def chest(bust: HeadArrays) -> np.ndarray:
    """Vertices of the chest's front, near its middle."""
    torso = np.asarray(bust.vertex_groups["torso"])
    places = np.asarray(bust.v_template)[torso]
    return torso[(np.abs(places[:, 0]) < 0.06) & (places[:, 2] > 0.03)]


def test_a_still_body_fades_over_the_last_rows(bust: HeadArrays):
    px = seen_px(bust)
    shown = BodyEnd.of(bust, [px] * 3, everywhere()).shown(px, SIZE)[:, SIZE // 2]
    assert shown[-1] < 0.02
    assert (shown[: -FADE_ROWS - 1] == 1).all()
    assert (np.diff(shown) <= 0).all()
    assert np.abs(np.diff(shown)).max() < 0.2


def test_beyond_the_frame_it_ends_where_the_frame_does(bust: HeadArrays):
    inside = everywhere()
    inside[200:] = False
    px = seen_px(bust, 0.05)
    shown = BodyEnd.of(bust, [px], inside).shown(px, SIZE)[:, SIZE // 2]
    assert (shown[200:] == 0).all()
    assert (shown[: 200 - FADE_ROWS - 1] == 1).all()


def test_a_place_of_the_chest_is_shown_alike_wherever_the_body_is(bust: HeadArrays):
    leaning = product((-0.02, 0.02), ((pitch, 0, roll) for pitch in (-5, 5) for roll in (-6, 6)))
    frames = [seen_px(bust, *pose) for pose in leaning]
    end = BodyEnd.of(bust, frames, everywhere())
    found = []
    for px in frames:
        column, row = np.floor(px[chest(bust)]).astype(int).T
        shown = end.shown(px, SIZE)[row.clip(0, SIZE - 1), column]
        found.append(np.ma.masked_array(shown, (row < 0) | (row >= SIZE)))
    shares = np.ma.stack(found)
    twice = shares.count(0) > 1
    assert (shares.min(0)[twice] < 0.5).any(), "some of them are at the end"
    assert np.ptp(shares, 0)[twice].max() < 0.35, "three rows of ten, by perspective"


def test_a_quarter_of_the_frames_shows_the_end(bust: HeadArrays):
    frames = [seen_px(bust, up_m) for up_m in np.linspace(-0.04, 0.04, 81)]
    end = BodyEnd.of(bust, frames, everywhere())
    shows = [end.shown(px, SIZE)[-1, SIZE // 2] < 0.02 for px in frames]
    assert np.mean(shows) == pytest.approx(0.25, abs=0.03)
    # Where the body is lowest, it goes on to the picture's edge.
    assert end.shown(frames[0], SIZE).min() == 1


def test_the_end_leans_with_the_body(bust: HeadArrays):
    px, inside = seen_px(bust, 0.05, (0, 0, 8)), everywhere()
    inside[220:] = False
    shown = BodyEnd.of(bust, [px], inside).shown(px, SIZE)
    half = [int(np.argmin(np.abs(shown[:, column] - 0.5))) for column in (88, 168)]
    assert np.degrees(np.arctan2(half[0] - half[1], 80)) == pytest.approx(8, abs=2)


@pytest.mark.parametrize("yaw_degrees", [20, 40, 60, 70, 80, 90])
def test_a_body_that_turns_keeps_most_of_itself(bust: HeadArrays, yaw_degrees: float):
    end = BodyEnd.of(bust, [seen_px(bust, 0.04)], everywhere())
    px = seen_px(bust, 0.04, (0, yaw_degrees, 0))
    shown = end.shown(px, SIZE)
    middle = px[chest(bust)][:, 0].mean().clip(0, SIZE - 1).astype(int)
    halfway = SIZE - int((shown[:, middle] < 0.5).sum())
    assert halfway == pytest.approx(SIZE - FADE_ROWS / 2, abs=2 * FADE_ROWS)
    assert shown[: SIZE // 2].min() == 1


def test_a_picture_that_ends_at_the_chin_ends_no_body(bust: HeadArrays):
    frames = [seen_px(bust, -0.19), seen_px(bust, -0.22)]
    end = BodyEnd.of(bust, frames, everywhere())
    assert end.height_m == pytest.approx(-0.11, abs=0.01), "the neck's foot"
    assert min(end.shown(px, SIZE).min() for px in frames) == 1


def test_of_a_body_seen_from_its_side_the_rows_tell(bust: HeadArrays):
    px = seen_px(bust)
    px[:, 0] = SIZE / 2
    shown = BodyEnd.of(bust, [px], everywhere()).shown(px, SIZE)
    assert (shown == shown[:, :1]).all()
    assert shown[-1, 0] < 0.02
    assert (shown[: -FADE_ROWS - 1] == 1).all()


def test_what_hung_on_the_part_that_is_cut_off_alone_is_cut_off_too(bust: HeadArrays):
    """A lamp beside the sleeve, which the matte holds together with it in the last rows."""
    px = seen_px(bust, 0.05)
    end = BodyEnd.of(bust, [px] * 3, everywhere())
    cut_out = CutOut(bust, end)
    outline = HeadMask(bust.faces, bust.skinning_weights).outline(px, px[0], px[0] + [0, 60], SIZE)
    body = mesh_silhouette(px, bust.faces, SIZE).astype(np.float32)
    lamp = np.zeros((SIZE, SIZE), np.float32)
    lamp[170:, :8] = 1
    floor = np.zeros_like(lamp)
    floor[SIZE - 4 :] = 1  # by which both hang together
    color, alone = np.full((SIZE, SIZE, 3), 90, np.uint8), np.maximum(body, floor)
    images = [
        cut_out(MattedCrop(color, matte, everywhere()), outline, px)
        for matte in (np.maximum(alone, lamp), alone)
    ]
    assert lamp[body > 0].sum() == 0, "beside the person"
    assert (alone * end.shown(px, SIZE) > 0.5).sum() > 2000
    np.testing.assert_array_equal(images[0][:, 8:], images[1][:, 8:])
    assert not images[0][:, :8, 3].any(), "nor what of it fades out"
    beside = cut_out(MattedCrop(color, body, everywhere()), outline, px)
    np.testing.assert_array_equal(beside[: SIZE - FADE_ROWS], images[1][: SIZE - FADE_ROWS])
