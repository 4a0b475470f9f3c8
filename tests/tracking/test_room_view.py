"""The room is found again in pictures of a camera that turns, and not where it cannot be."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbavatar_ns.tracking.image.background import Background, CleanPlate, find_background
from rgbavatar_ns.tracking.image.known_room import KnownRoom
from rgbavatar_ns.tracking.image.room_view import RoomView
from rgbavatar_ns.tracking.image.unsure_band import RoomColors

SIZE, FOCAL_PX = 240, 320.0
INSIDE = np.ones((SIZE, SIZE), bool)
SHIRT = np.array([200.0, 60, 60])


def _shelf(seed: int = 0) -> np.ndarray:
    """Boxes of all colours, a little out of focus."""
    random = np.random.default_rng(seed)
    room = np.zeros((SIZE, SIZE, 3), np.float32)
    for _ in range(260):
        left, top = random.integers(-10, SIZE, 2)
        wide, high = random.integers(8, 30, 2)
        room[max(top, 0) : top + high, max(left, 0) : left + wide] = random.uniform(20, 230, 3)
    return cv2.GaussianBlur(room, (0, 0), 0.8)


def _turned(pitch: float, yaw: float, roll: float) -> np.ndarray:
    """What a camera's turn by these degrees does to a picture, worked from its lens."""
    lens = np.array([[FOCAL_PX, 0, SIZE / 2], [0, FOCAL_PX, SIZE / 2], [0, 0, 1]])
    turn = cv2.Rodrigues(np.deg2rad([pitch, yaw, roll]))[0]
    return lens @ turn @ np.linalg.inv(lens)


def _seen(room: np.ndarray, homography: np.ndarray) -> np.ndarray:
    return cv2.warpPerspective(
        room, homography, (SIZE, SIZE), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def _disc(x: float, radius: float = 50) -> np.ndarray:
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    return np.clip(radius - np.hypot(rows - 130, columns - x) + 0.5, 0, 1).astype(np.float32)


def _picture(room: np.ndarray, person: np.ndarray, seed: int = 0) -> np.ndarray:
    picture = person[..., None] * SHIRT + (1 - person[..., None]) * room
    noise = np.random.default_rng(seed).normal(0, 1.5, picture.shape)
    return np.clip(picture + noise, 0, 255).round().astype(np.uint8)


def _found(view_of: np.ndarray, in_room: np.ndarray):
    view = RoomView.of(_picture(view_of, _disc(110), 1), _disc(110, 60) == 0)
    assert view is not None
    return view.found_in(_picture(in_room, _disc(135), 2), _disc(135, 60) == 0)


@pytest.mark.parametrize("degrees", [(0.0, 0, 0), (0.4, -0.7, 0.5), (-2.0, 3.0, -2.0)])
def test_a_turn_of_the_camera_is_found_to_fractions_of_a_pixel(
    degrees: tuple[float, float, float],
) -> None:
    true, room = _turned(*degrees), _shelf()
    found = _found(room, _seen(room, true))
    assert found is not None
    places = np.mgrid[10:SIZE:40, 10:SIZE:40].reshape(2, 1, -1).T.astype(np.float64)
    off = cv2.perspectiveTransform(places, found.homography) - cv2.perspectiveTransform(
        places, true
    )
    assert np.hypot(*off[:, 0].T).max() < 0.4
    assert found.elsewhere.mean() < 0.03


def test_what_stands_nearer_is_told_to_be_elsewhere() -> None:
    room, moved = _shelf(), _shelf()
    moved[:, 5:245] = room[:, :235]
    nearer = np.zeros((SIZE, SIZE), bool)
    nearer[150:, 180:] = True
    found = _found(room, np.where(nearer[..., None], moved, room))
    assert found is not None
    assert found.elsewhere[165:225, 195:230].mean() > 0.8
    assert found.elsewhere[:130].mean() < 0.02


def test_a_plain_wall_and_another_room_and_two_that_move_apart_are_not_found() -> None:
    room, plain = _shelf(), np.full((SIZE, SIZE, 3), 180, np.float32)
    assert RoomView.of(plain.astype(np.uint8), INSIDE) is None
    assert _found(room, plain) is None
    assert _found(room, _shelf(5)) is None
    apart = room.copy()
    apart[:, 126:] = room[:, 120:234]
    assert _found(room, apart) is None


def _film(room: np.ndarray, frames: int = 24) -> tuple[list, list[np.ndarray]]:
    """Pictures with mattes of a disc that walks before a camera in a hand, and how it turned."""
    turns = [
        _turned(1.2 * np.sin(0.9 * k), 1.5 * np.sin(0.6 * k + 1), 0.8 * np.sin(1.3 * k))
        for k in range(frames)
    ]
    samples = []
    for k, turn in enumerate(turns):
        person = _disc(120 + 45 * np.sin(2 * np.pi * k / frames))
        samples.append((_picture(_seen(room, turn), person, k), person))
    return samples, turns


def _off(known: KnownRoom, room: np.ndarray, sample: tuple, turn: np.ndarray) -> np.ndarray:
    """How far the room that a picture is said to show is from what it shows, where known."""
    behind = known.behind(*sample)
    assert behind is not None
    assert behind.colors.known.mean() > 0.5
    off = np.abs(behind.colors.color - _seen(room, turn)).max(-1)
    return off[behind.colors.known]


def test_a_camera_in_a_hand_shows_what_the_person_covers(tmp_path: Path) -> None:
    room = _shelf()
    samples, turns = _film(room)
    find_background(samples, INSIDE).save(tmp_path / "background.npz", "")
    found = Background.load(tmp_path / "background.npz")
    assert found.kind == "moves"
    assert found.motion_px is not None
    assert found.motion_px > 2
    known = KnownRoom.of(found, INSIDE)
    assert known is not None
    for k in (0, 5, 17):
        off = _off(known, room, samples[k], turns[k])
        assert np.median(off) < 4
        assert np.percentile(off, 95) < 20
        # Behind the person too, though this picture does not show it.
        behind = known.behind(*samples[k])
        assert behind is not None
        assert (behind.colors.known & (samples[k][1] > 0.5)).sum() > 500
    blank = np.full((SIZE, SIZE, 3), 128, np.uint8)
    assert known.behind(blank, _disc(120)) is None


def test_one_picture_that_is_lost_costs_no_plate() -> None:
    room = _shelf()
    samples, _ = _film(room)
    samples[len(samples) // 2] = (np.full((SIZE, SIZE, 3), 90, np.uint8), samples[0][1])
    found = find_background(samples, INSIDE)
    assert found.kind == "moves"
    assert found.plate is not None
    assert found.plate.known.mean() > 0.5


def test_beyond_what_is_known_any_colour_may_be() -> None:
    room = RoomColors(_shelf(), np.full((SIZE, SIZE), 9.0, np.float32), INSIDE)
    elsewhere = np.zeros((SIZE, SIZE), bool)
    elsewhere[100:140, 100:140] = True
    shift = np.array([[1.0, 0, 20], [0, 1, 0], [0, 0, 1]])
    seen = room.seen_from(shift, elsewhere)
    np.testing.assert_allclose(seen.color[:, : SIZE - 20], room.color[:, 20:], atol=1e-3)
    unknown = np.zeros((SIZE, SIZE), bool)
    unknown[:, SIZE - 20 :] = unknown[100:140, 80:120] = True
    np.testing.assert_array_equal(seen.known, ~unknown)
    assert seen.variance[unknown].min() > 40**2
    np.testing.assert_allclose(seen.variance[~unknown], 9, rtol=1e-4)
    np.testing.assert_allclose(seen.color[:, -1], room.color[:, -1], atol=1e-3)


def test_a_room_of_two_that_move_apart_gives_no_plate() -> None:
    room, farther = _shelf(), _shelf(5)
    samples, _ = _film(room)
    for k, (image, person) in enumerate(samples):
        shift = np.array([[1.0, 0, 6 * np.sin(k)], [0, 1, 0], [0, 0, 1]])
        other = _seen(farther, shift)
        image[:, 120:] = _picture(other, person, k)[:, 120:]
    found = find_background(samples, INSIDE)
    assert found.kind == "moves"
    assert found.plate is None


def test_a_still_camera_s_room_is_the_same_in_all_pictures() -> None:
    room = _shelf()
    samples = [(_picture(room, _disc(80 + 4 * k), k), _disc(80 + 4 * k)) for k in range(20)]
    found = find_background(samples, INSIDE)
    assert found.kind == "still"
    known = KnownRoom.of(found, INSIDE)
    assert known is not None
    assert known.view is None
    for k in (0, 9):
        assert np.percentile(_off(known, room, samples[k], np.eye(3)), 95) < 5


def test_a_moving_room_of_no_corners_is_known_to_no_picture() -> None:
    plain = np.full((SIZE, SIZE, 3), 180, np.uint8)
    plate = CleanPlate(plain, np.full((SIZE, SIZE), 9, np.uint8), np.ones((SIZE, SIZE), np.float32))
    assert KnownRoom.of(Background("moves", 2.0, 0.0, plate), INSIDE) is None
