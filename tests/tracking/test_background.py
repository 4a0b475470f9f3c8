"""A clean plate is found where the camera stands, and none where camera or light move."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.image.background import (
    Background,
    find_background,
    sampled_positions,
)
from rgbavatar_ns.tracking.image.hair import HairColors

SIZE, FRAMES = 96, 24
INSIDE = np.ones((SIZE, SIZE), bool)


def _room(seed: int = 0) -> np.ndarray:
    """Coloured boxes with steep edges."""
    random = np.random.default_rng(seed)
    cells = random.uniform(30, 220, (12, 12, 3)).astype(np.float32)
    return cv2.resize(cells, (SIZE, SIZE), interpolation=cv2.INTER_NEAREST)


def _disc(x: float, radius: float = 22) -> np.ndarray:
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    return np.clip(radius - np.hypot(rows - 56, columns - x) + 0.5, 0, 1).astype(np.float32)


def _film(
    room: np.ndarray, sway_px: float = 0.0, light: float = 0.0, mistaken: int = 0
) -> list[tuple[np.ndarray, np.ndarray]]:
    """A disc that walks to and fro before the room; `mistaken` mattes miss it altogether."""
    random = np.random.default_rng(1)
    film = []
    for k in range(FRAMES):
        mask = _disc(48 + 20 * np.sin(2 * np.pi * k / FRAMES))
        moved = np.float32([[1, 0, sway_px * np.sin(k)], [0, 1, sway_px * np.cos(1.7 * k)]])
        behind = cv2.warpAffine(room, moved, (SIZE, SIZE), borderMode=cv2.BORDER_REPLICATE)
        behind = behind * (1 + light * np.sin(0.9 * k))
        picture = mask[..., None] * (190, 140, 110) + (1 - mask[..., None]) * behind
        picture = np.clip(picture + random.normal(0, 1.5, picture.shape), 0, 255)
        film.append((picture.round().astype(np.uint8), mask if k >= mistaken else 0 * mask))
    return film


def test_lost_mattes_are_told_also_where_most_of_the_crop_was_never_filmed() -> None:
    film, inside = _film(_room(), mistaken=5), INSIDE.copy()
    inside[:, :8], inside[:36], inside[78:] = False, False, False
    found = find_background(film, inside)
    assert found.plate is not None
    covered = np.all([mask > 0.3 for _, mask in film[5:]], axis=0) & inside
    assert covered.any()
    assert not found.plate.known[covered].any()


def test_what_is_uncovered_is_known_to_the_noise_and_the_rest_is_not() -> None:
    room, film = _room(), _film(_room())
    found = find_background(film, INSIDE)
    assert found.kind == "still"
    assert found.camera_is_still is True
    assert found.plate is not None
    free = np.sum([mask < 0.02 for _, mask in film], axis=0)
    known = found.plate.known
    assert known[free >= 6].mean() > 0.97
    covered = np.all([mask > 0.3 for _, mask in film], axis=0)
    assert covered.sum() > 50
    assert not known[covered].any()
    off = np.abs(found.plate.color.astype(float) - room).max(-1)
    assert np.median(off[known]) < 1.5
    assert np.percentile(off[known], 99) < 8
    np.testing.assert_array_equal(found.plate.color[covered], 0)


def test_a_few_mattes_that_miss_the_person_leave_no_ghost() -> None:
    room, film = _room(), _film(_room(), mistaken=3)
    found = find_background(film, INSIDE)
    assert found.plate is not None
    off = np.abs(found.plate.color.astype(float) - room).max(-1)
    assert (off[found.plate.known] > 20).mean() < 0.01


def test_mattes_that_lose_the_person_do_not_count() -> None:
    room, film = _room(), _film(_room(), mistaken=FRAMES // 3)
    found = find_background(film, INSIDE)
    assert found.plate is not None
    off = np.abs(found.plate.color.astype(float) - room).max(-1)
    assert (off[found.plate.known] > 20).mean() < 0.01


def test_what_every_matte_leaves_out_of_the_person_does_not_move_a_plain_wall() -> None:
    """A dark brim to both sides of the disc, which goes with it."""
    film = []
    for k, (image, mask) in enumerate(_film(np.full((SIZE, SIZE, 3), 200, np.float32))):
        middle = round(48 + 20 * np.sin(2 * np.pi * k / FRAMES))
        picture, brim = image.copy(), np.zeros((SIZE, SIZE), bool)
        brim[44:50, max(0, middle - 26) : middle + 26] = True
        picture[brim & (mask < 0.02)] = (40, 50, 45)
        film.append((picture, mask))
    found = find_background(film, INSIDE)
    assert found.kind == "still"
    assert found.camera_is_still is None


def test_an_island_in_the_person_is_no_room() -> None:
    """All mattes have a hole that goes with the person and is larger than the way it goes."""
    room, film = _room(), []
    for k in range(FRAMES):
        x = 48 + 3 * np.sin(2 * np.pi * k / FRAMES)
        mask = _disc(x, 30)
        picture = mask[..., None] * (190, 140, 110) + (1 - mask[..., None]) * room
        film.append((picture.round().astype(np.uint8), mask * (1 - _disc(x, 7))))
    found = find_background(film, INSIDE)
    assert found.plate is not None
    assert found.plate.known[:8].all()
    assert not found.plate.known[_disc(48, 18) > 0.5].any()


@pytest.mark.parametrize("sway_px", [1.5, 6.0])
def test_a_moving_camera_is_noticed(sway_px: float) -> None:
    found = find_background(_film(_room(), sway_px=sway_px), INSIDE)
    assert found.kind == "moves"
    assert found.camera_is_still is False
    assert found.plate is None


def test_changing_light_is_noticed_and_no_motion() -> None:
    found = find_background(_film(np.full((SIZE, SIZE, 3), 120, np.float32), light=0.25), INSIDE)
    assert found.kind == "light changes"
    assert found.light_levels > 10
    assert found.plate is None
    found = find_background(_film(_room(), light=0.02), INSIDE)
    assert found.kind == "still"


def test_a_blank_wall_gives_a_plate_and_does_not_tell_of_the_camera() -> None:
    wall = np.full((SIZE, SIZE, 3), 200, np.float32)
    found = find_background(_film(wall, sway_px=4), INSIDE)
    assert found.plate is not None
    assert found.camera_is_still is None


def test_too_few_frames_and_a_covered_room_tell_nothing() -> None:
    film = _film(_room())
    assert find_background(film[:5], INSIDE).kind == "too short"
    covered = find_background([(image, np.ones_like(mask)) for image, mask in film], INSIDE)
    assert covered.kind == "covered"
    assert covered.camera_is_still is None


def test_what_is_kept_comes_back(tmp_path: Path) -> None:
    for film in (_film(_room()), _film(_room(), sway_px=5)):
        found = find_background(film, INSIDE)
        found.save(tmp_path / "background.npz", "")
        again = Background.load(tmp_path / "background.npz")
        assert again.report() == found.report()
        assert (again.plate is None) == (found.plate is None)
        if again.plate is not None and found.plate is not None:
            np.testing.assert_array_equal(again.plate.color, found.plate.color)
            np.testing.assert_array_equal(again.plate.known, found.plate.known)
        assert again.hair is None
    found = replace(find_background(_film(_room()), INSIDE), hair=_hair())
    found.save(tmp_path / "background.npz", "")
    again = Background.load(tmp_path / "background.npz").hair
    assert again is not None
    np.testing.assert_array_equal(again.hair, _hair().hair)
    np.testing.assert_array_equal(again.room, _hair().room)


def _hair() -> HairColors:
    pixels = np.random.default_rng(0).integers(0, 60, (400, 3)).astype(np.uint8)
    found = HairColors.of(pixels, _room().astype(np.uint8), INSIDE, INSIDE)
    assert found is not None
    return found


@pytest.mark.parametrize(
    "changed",
    [
        {"kind": "new"},
        {"seen": np.zeros((3, 3), np.uint8)},
        {"motion": np.zeros(4)},
        {"hair": np.zeros((4, 4, 4), np.float32)},
        {"room": np.full((32, 32, 32), np.nan, np.float32)},
        {"room": np.zeros((32, 32, 32))},
    ],
)
def test_a_damaged_or_foreign_background_is_told(tmp_path: Path, changed: dict) -> None:
    path = tmp_path / "background.npz"
    replace(find_background(_film(_room()), INSIDE), hair=_hair()).save(path, "")
    with np.load(path) as held:
        arrays = dict(held)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(UserError, match="no background that was found"):
        Background.load(path)
    np.savez(path, **(arrays | changed))
    with pytest.raises(UserError, match=r"(?s)no background.*same command again"):
        Background.load(path)


def test_samples_are_spread_and_their_memory_is_bounded() -> None:
    assert sampled_positions(10, 256) == list(range(10))
    spread = sampled_positions(5000, 512)
    assert len(spread) == 40
    assert (spread[0], spread[-1]) == (0, 4999)
    assert np.ptp(np.diff(spread)) <= 1
    assert len(sampled_positions(5000, 2048)) * 3 * 2048**2 <= 256 * 2**20
