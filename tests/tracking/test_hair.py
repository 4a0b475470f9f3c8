"""Hair that every segmentation leaves out is found by its colours, where the room is not known."""

import cv2
import numpy as np
import pytest

from rgbavatar_ns.tracking.image.background import CleanPlate, find_background
from rgbavatar_ns.tracking.image.hair import HairColors, HairSearch, hair_pixels
from rgbavatar_ns.tracking.image.unsure_band import RoomColors, band_matte

SIZE, FRAMES = 240, 24
HAIR, SKIN = np.array([58.0, 42.0, 34.0]), np.array([205.0, 160.0, 135.0])
SHIRT = np.array([60.0, 90.0, 150.0])
INSIDE = np.ones((SIZE, SIZE), bool)
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE]


def _shelf() -> np.ndarray:
    """Coloured boxes, a few of them nearly as dark as hair."""
    cells = np.random.default_rng(3).uniform(25, 230, (16, 16, 3)).astype(np.float32)
    return cv2.resize(cells, (SIZE, SIZE), interpolation=cv2.INTER_NEAREST)


def _ellipse(row: float, column: float, tall: float, wide: float) -> np.ndarray:
    return ((ROWS - row) / tall) ** 2 + ((COLUMNS - column) / wide) ** 2 < 1


def _middle(k: int) -> float:
    """The head's column: it never comes back to where it was."""
    return 120 + 14 * np.sin(1.7 * k)


def _frame(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A head on a body that swings with its hair: what is filmed, the truth, the segmentation,
    which holds crown, face and body alone and leaves the hair beside them out."""
    middle = _middle(k)
    face, crown = _ellipse(95, middle, 45, 30), _ellipse(80, middle, 50, 38) & (ROWS < 70)
    body = _ellipse(260, 120, 95, 90)
    hangs = (np.abs(COLUMNS - middle) < 46) & (ROWS > 60) & (ROWS < 165)
    person = face | crown | body | hangs
    strands = HAIR * (1 + 0.25 * np.sin(0.9 * (COLUMNS - middle) + 0.3 * ROWS))[..., None]
    picture = np.where(person[..., None], strands, _shelf())
    picture[body] = SHIRT
    picture[face & ~crown] = SKIN
    noise = np.random.default_rng(k).normal(0, 2, picture.shape)
    image = np.clip(picture + noise, 0, 255).round().astype(np.uint8)
    coarse = cv2.GaussianBlur((face | crown | body).astype(np.float32), (0, 0), 2)
    return image, person, coarse


def _inner(mask: np.ndarray) -> np.ndarray:
    return cv2.erode(mask.astype(np.uint8), np.ones((5, 5))) > 0


def _landmarks(k: int) -> np.ndarray:
    turns = np.linspace(0, 2 * np.pi, 60)
    return np.stack([_middle(k) + 28 * np.sin(turns), 98 + 40 * np.cos(turns)], -1).astype(
        np.float32
    )


FILM = [_frame(k) for k in range(FRAMES)]


def _told() -> tuple[RoomColors, HairSearch]:
    plate = find_background([(image, coarse) for image, _, coarse in FILM], INSIDE).plate
    assert plate is not None
    hair = [hair_pixels(image, coarse, _landmarks(k)) for k, (image, _, coarse) in enumerate(FILM)]
    colors = HairColors.of(np.concatenate(hair), plate.color, plate.known)
    assert colors is not None
    room = RoomColors.of_plate(plate)
    return room, HairSearch.of(colors, room.color, room.variance, room.known, INSIDE)


def test_hair_left_out_of_every_matte_is_of_the_person_and_the_room_it_uncovers_is_not() -> None:
    room, hair = _told()
    before, after, beside = [], [], []
    for image, person, coarse in FILM:
        found = hair.with_overlooked(coarse, image)
        alpha = band_matte(image, found, room).alpha
        far = cv2.dilate(coarse, np.ones((9, 9))) < 0.5
        left_out, uncovered = (_inner(one & far) for one in (person, ~person & ~room.known))
        before.append(band_matte(image, coarse, room).alpha[left_out].mean())
        after.append(alpha[left_out].mean())
        beside.append(alpha[uncovered])
    assert np.mean(before) < 0.5
    assert np.mean(after) > 0.95
    assert min(after) > 0.9
    assert np.concatenate(beside).size > 1000
    assert np.concatenate(beside).mean() < 0.15


def test_what_the_segmentation_holds_and_a_room_that_is_seen_stay_as_they_are() -> None:
    room, hair = _told()
    for image, person, coarse in FILM[::5]:
        found = hair.with_overlooked(coarse, image)
        assert (found >= coarse).all()
        away = _inner(
            room.known & ~person & (cv2.dilate(person.astype(np.uint8), np.ones((9, 9))) == 0)
        )
        assert away.mean() > 0.3
        assert (found - coarse)[away].max() < 0.05


def test_nothing_is_looked_for_beyond_what_was_filmed() -> None:
    room, hair = _told()
    image, _, coarse = FILM[5]
    nowhere = HairSearch.of(hair.colors, room.color, room.variance, room.known, ~INSIDE)
    np.testing.assert_array_equal(nowhere.with_overlooked(coarse, image), coarse)


@pytest.mark.parametrize("wall", [HAIR + 14, SKIN])
def test_the_surroundings_tell_a_plain_wall_from_hair_of_nearly_its_colour(
    wall: np.ndarray,
) -> None:
    """In a window that nobody ever uncovers, half is hair and half the wall around."""
    noise = np.random.default_rng(0).normal(0, 2, (SIZE, SIZE, 3))
    left = (COLUMNS < 120)[..., None]
    window = (np.abs(ROWS - 120) < 30) & (np.abs(COLUMNS - 120) < 30)
    picture = np.where(left & window[..., None], HAIR, wall) + noise
    image = np.clip(picture, 0, 255).round().astype(np.uint8)
    seen = np.where(window, 0, 20).astype(np.uint8)
    color = np.where(window[..., None], 0, image).astype(np.uint8)
    room = RoomColors.of_plate(CleanPlate(color, seen, np.full((SIZE, SIZE), 2, np.float32)))
    pixels = np.clip(HAIR + noise.reshape(-1, 3)[:5000], 0, 255).round().astype(np.uint8)
    hair = HairColors.of(pixels, color, room.known)
    assert hair is not None
    nothing = np.zeros((SIZE, SIZE), np.float32)
    search = HairSearch.of(hair, room.color, room.variance, room.known, INSIDE)
    found = search.with_overlooked(nothing, image)
    assert found[100:140, 100:115].min() > 0.9
    assert found[100:140, 125:140].max() < 0.1


def test_hair_is_looked_for_above_and_beside_the_face_alone() -> None:
    image, _, coarse = FILM[0]
    pixels = hair_pixels(image, coarse, _landmarks(0)).astype(float)
    assert len(pixels) > 50
    off = {name: np.abs(pixels - color).mean(1) for name, color in zip("hs", (HAIR, SKIN))}
    assert (off["h"] < off["s"]).mean() > 0.98
    assert not len(hair_pixels(image, np.zeros_like(coarse), _landmarks(0)))


def test_without_hair_or_without_a_room_there_is_nothing_to_tell() -> None:
    room, none = FILM[0][0], np.zeros((0, 3), np.uint8)
    assert HairColors.of(none, room, INSIDE & (COLUMNS < 40)) is None
    assert HairColors.of(room[0], room, ~INSIDE) is None
