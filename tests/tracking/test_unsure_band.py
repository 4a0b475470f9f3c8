"""Alpha in the unsure band: strands, one piece, no holes, the right colour, and its cost."""

from typing import Any

import cv2
import numpy as np
import pytest

from rgbavatar_ns.tracking.image import unsure_band
from rgbavatar_ns.tracking.image.background import CleanPlate
from rgbavatar_ns.tracking.image.matting import foreground_color, refined_matte
from rgbavatar_ns.tracking.image.unsure_band import RoomColors, band_matte

SIZE = 240
HAIR, SKIN = (60, 45, 35), (200, 150, 125)


def _room(busy: bool) -> np.ndarray:
    random = np.random.default_rng(3)
    cells = random.uniform(40, 220, (16, 16, 3)) if busy else random.uniform(170, 215, (3, 3, 1))
    method = cv2.INTER_NEAREST if busy else cv2.INTER_LINEAR
    room = cv2.resize(cells.astype(np.float32), (SIZE, SIZE), interpolation=method)
    return np.broadcast_to(room.reshape(SIZE, SIZE, -1), (SIZE, SIZE, 3)).astype(np.float32)


def _head(strands: bool) -> np.ndarray:
    """True alpha: a disc, with fine lines that stand off."""
    large = np.zeros((SIZE * 4, SIZE * 4), np.float32)
    cv2.circle(large, (480, 560), 260, 1.0, -1)
    if strands:
        for angle in np.linspace(np.pi * 1.1, np.pi * 1.9, 12):
            ends = [(480 + r * np.cos(angle), 560 + r * np.sin(angle)) for r in (250, 320)]
            cv2.line(large, *[tuple(np.round(end).astype(int).tolist()) for end in ends], 0.8, 3)
    return cv2.resize(large, (SIZE, SIZE), interpolation=cv2.INTER_AREA)


def _filmed(room: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    rows = np.arange(SIZE)[:, None, None]
    color = np.where(rows < 140, np.array(HAIR), np.array(SKIN))
    noise = np.random.default_rng(5).normal(0, 1.5, room.shape)
    picture = alpha[..., None] * color + (1 - alpha[..., None]) * room + noise
    return np.clip(picture, 0, 255).round().astype(np.uint8)


def _coarse(alpha: np.ndarray) -> np.ndarray:
    """What a segmentation of few pixels makes of it: a little too large, no strands."""
    body = cv2.morphologyEx(alpha, cv2.MORPH_OPEN, np.ones((9, 9), np.uint8))
    wide = cv2.dilate(body, np.ones((5, 5), np.uint8))
    return cv2.GaussianBlur(wide, (0, 0), 2.5)


def _plate(room: np.ndarray) -> RoomColors:
    seen = np.full((SIZE, SIZE), 20, np.uint8)
    spread = np.full((SIZE, SIZE), 1.5, np.float32)
    return RoomColors.of_plate(CleanPlate(room.round().astype(np.uint8), seen, spread))


@pytest.mark.parametrize("busy", [False, True])
def test_with_a_plate_the_error_is_less_than_half_of_the_guided_filter_s(busy: bool) -> None:
    room, alpha = _room(busy), _head(strands=True)
    image, coarse = _filmed(room, alpha), _coarse(alpha)
    found = band_matte(image, coarse, _plate(room)).alpha
    plain = refined_matte(image, coarse)
    assert found.dtype == np.float32
    assert 0 <= found.min() <= found.max() <= 1
    assert np.abs(found - alpha).mean() < 0.5 * np.abs(plain - alpha).mean()


def test_strands_are_found_where_the_room_is_known_and_only_there() -> None:
    room, alpha = _room(busy=False), _head(strands=True)
    strands = (alpha > 0.3) & (_head(strands=False) == 0)
    found = band_matte(_filmed(room, alpha), _coarse(alpha), _plate(room)).alpha
    np.testing.assert_allclose(found[strands].mean(), alpha[strands].mean(), atol=0.1)
    assert found[cv2.dilate(alpha, np.ones((5, 5), np.uint8)) == 0].max() < 0.1


def test_hair_before_an_ear_is_hair_and_not_ear() -> None:
    """A dark strand on a wall beside light skin: its share of the person is its own colour's."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    alpha = (columns < 120).astype(np.float32)
    strand = (rows % 12 == 0) & (columns >= 120) & (columns < 130)
    alpha[strand] = 0.6
    hair = strand | (columns < 108)
    color = np.where(hair[..., None], np.array(HAIR), np.array(SKIN))
    room = np.full((SIZE, SIZE, 3), 205.0)
    noise = np.random.default_rng(2).normal(0, 1.5, room.shape)
    picture = alpha[..., None] * color + (1 - alpha[..., None]) * room + noise
    image = np.clip(picture, 0, 255).round().astype(np.uint8)
    coarse = cv2.GaussianBlur((columns < 120).astype(np.float32), (0, 0), 2.5)
    found = band_matte(image, coarse, _plate(room)).alpha
    inner = strand & (columns >= 123) & (rows > 20) & (rows < SIZE - 20)
    # Explained with the person's mean colours near by alone it comes out at .37.
    np.testing.assert_allclose(found[inner].mean(), 0.6, atol=0.08)


def test_a_coloured_wall_is_seen_through_hair_that_never_uncovers_it() -> None:
    wall, hair = np.array([30.0, 150.0, 190.0]), np.array(HAIR, float)
    rows = np.arange(SIZE)[:, None] + np.zeros((SIZE, SIZE))
    # Between rows 100 and 106 a third of what is seen is the wall.
    alpha = np.where(rows < 100, 0, np.where(rows < 106, 2 / 3, 1)).astype(np.float32)
    noise = np.random.default_rng(4).normal(0, 1.5, (SIZE, SIZE, 3))
    picture = alpha[..., None] * hair + (1 - alpha[..., None]) * wall + noise
    image = np.clip(picture, 0, 255).round().astype(np.uint8)
    coarse = cv2.GaussianBlur((rows >= 100).astype(np.float32), (0, 0), 1.5)
    seen = np.where(rows < 97, 20, 0).astype(np.uint8)
    color = np.where(seen[..., None] > 0, wall, 0).round().astype(np.uint8)
    plate = RoomColors.of_plate(CleanPlate(color, seen, np.full((SIZE, SIZE), 1.5, np.float32)))
    found = band_matte(image, coarse, plate).alpha
    within = found[102:105, 20:-20]
    np.testing.assert_allclose(within.mean(), 2 / 3, atol=0.12)
    assert found[112:].min() == 1


def test_without_a_plate_the_frame_s_own_surroundings_serve() -> None:
    room, alpha = _room(busy=False), _head(strands=False)
    image, coarse = _filmed(room, alpha), _coarse(alpha)
    found, plain = band_matte(image, coarse).alpha, refined_matte(image, coarse)
    assert np.abs(found - alpha).mean() < 0.6 * np.abs(plain - alpha).mean()


def test_the_person_is_one_piece() -> None:
    room, alpha = _room(busy=False), _head(strands=False)
    picture = _filmed(room, alpha)
    picture[10:30, 200:225] = (90, 60, 200)
    coarse = _coarse(alpha)
    coarse[10:30, 200:225] = 0.9
    found = band_matte(picture, coarse, _plate(room)).alpha
    assert found[:40, 190:].max() == 0
    assert found[130:150, 110:130].min() == 1


def test_a_hole_of_the_segmentation_is_filled_unless_the_room_shows_through() -> None:
    room, alpha = _room(busy=False), _head(strands=False)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    hole = np.hypot(rows - 150, columns - 120) < 6
    coarse = _coarse(alpha)
    coarse[cv2.dilate(hole.astype(np.uint8), np.ones((3, 3))) > 0] = 0.2
    plate = _plate(room)
    assert band_matte(_filmed(room, alpha), coarse, plate).alpha[hole].min() > 0.9
    assert band_matte(_filmed(room, alpha), coarse).alpha[hole].min() > 0.9
    through = np.where(hole, 0, alpha)
    assert band_matte(_filmed(room, through), coarse, plate).alpha[hole].mean() < 0.1


def test_soft_edges_have_the_person_s_colour() -> None:
    room, alpha = _room(busy=True), _head(strands=False)
    image = _filmed(room, alpha)
    found = band_matte(image, _coarse(alpha), _plate(room))
    color = foreground_color(image, found.alpha, found.background)
    soft = (alpha > 0.3) & (alpha < 0.9) & (np.arange(SIZE)[:, None] < 130)
    off = np.abs(color[soft].astype(float) - HAIR).mean()
    assert off < 0.45 * np.abs(image[soft].astype(float) - HAIR).mean()


def test_a_lamp_that_flickers_does_not_matter() -> None:
    room, alpha = _room(busy=False), _head(strands=False)
    image = _filmed(room, alpha)
    brighter = np.clip(image * 1.03, 0, 255).astype(np.uint8)
    plate = _plate(room)
    found = [band_matte(one, _coarse(alpha), plate).alpha for one in (image, brighter)]
    assert np.abs(found[1] - found[0]).mean() < 0.002


def test_the_cost_is_bounded_by_the_band(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is asked of colours grows with the outline's length and not with the person's area."""
    asked: list[int] = []
    real = unsure_band.mixed_alpha

    def counted(*given: Any) -> np.ndarray:
        asked.append(len(given[-1]))
        return real(*given)

    monkeypatch.setattr(unsure_band, "mixed_alpha", counted)
    for radius in (60, 180):
        alpha = np.zeros((480, 480), np.float32)
        cv2.circle(alpha, (240, 240), radius, 1.0, -1)
        image = np.where(alpha[..., None] > 0, np.array(SKIN), 180).astype(np.uint8)
        band_matte(image, cv2.GaussianBlur(alpha, (0, 0), 3))
        assert asked[-1] < 2 * np.pi * radius * 24
    assert asked[1] < 4 * asked[0]
