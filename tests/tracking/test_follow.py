"""Which face is followed: laws over drawn boxes, and real faces that cross in one picture."""

import re
import tracemalloc
from contextlib import closing

import cv2
import numpy as np
import pytest

from rgbavatar_ns.tracking.face.clip import SeenFaces, followed_face, rate_notes
from rgbavatar_ns.tracking.face.detector import IRIS_CENTERS
from rgbavatar_ns.tracking.face.find_faces import sharpness
from rgbavatar_ns.tracking.face.follow import FaceFollower

from .clips import astronaut

WIDTH, HEIGHT = 640, 480
SHAPE = np.random.default_rng(0).uniform(-0.5, 0.5, (478, 2)) * (0.8, 1.0)
SHAPE[10], SHAPE[152] = (0, -0.5), (0, 0.5)


def _face(x: float, y: float, height: float = 100) -> np.ndarray:
    return SHAPE * height + (x, y)


def _follow(frames: list[list[np.ndarray]]) -> list[tuple[int | None, int]]:
    follower = FaceFollower()
    seen = [follower(np.array(faces).reshape(-1, 478, 2), WIDTH, HEIGHT) for faces in frames]
    return [(one.position, one.others) for one in seen]


def test_the_largest_and_most_central_face_is_chosen_first() -> None:
    small, large, far = _face(450, 240, 60), _face(300, 240, 130), _face(60, 60, 135)
    for order in ([small, large, far], [far, small, large], [large, far, small]):
        ((position, others),) = _follow([order])
        assert position is not None
        assert order[position] is large
        assert others == 2


def test_a_larger_face_that_enters_is_not_followed() -> None:
    frames = [[_face(320, 240)] for _ in range(5)]
    frames += [[_face(640 - 20 * k, 240, 180), _face(320, 240)] for k in range(7)]
    assert _follow(frames) == [(0, 0)] * 5 + [(1, 1)] * 7


def test_crossing_faces_keep_their_names_whatever_order_they_come_in() -> None:
    random = np.random.default_rng(3)
    for _ in range(8):
        follower = FaceFollower()
        for frame in range(60):
            # The followed one stands, another of the same size walks by; hidden, neither is seen.
            standing = _face(320 + random.normal(), 240 + random.normal())
            walking = _face(60 + 9 * frame, 250)
            hidden = np.abs(walking - standing).max() < 45
            faces = [walking] if hidden else [standing, walking]
            random.shuffle(faces)
            sighting = follower(np.array(faces), WIDTH, HEIGHT)
            if not hidden:
                assert sighting.position is not None
                assert faces[sighting.position] is standing, frame
            assert not sighting.jumped


def test_a_lost_face_leaves_a_gap_that_another_one_never_fills() -> None:
    frames = [[_face(320, 240), _face(100, 200)] for _ in range(20)]
    frames += [[_face(100 + k, 200)] for k in range(80)]
    frames += [[_face(180, 200), _face(330, 240)]]
    assert _follow(frames) == [(0, 1)] * 20 + [(None, 1)] * 80 + [(1, 1)]


def test_after_a_cut_the_face_is_found_again_elsewhere() -> None:
    follower = FaceFollower()
    for _ in range(30):
        assert follower(_face(200, 200)[None], WIDTH, HEIGHT).position == 0
    after = [follower(_face(480, 300, 160)[None], WIDTH, HEIGHT) for _ in range(12)]
    found = [one.position is not None for one in after]
    assert not found[0], "it may come back where it was"
    assert found[6:] == [True] * 6
    assert [one.jumped for one in after].count(True) == 1


def test_a_mistaken_first_choice_gives_way() -> None:
    # A picture on the wall is seen for three frames; the person is there all the time.
    frames = [[_face(320, 240, 140), _face(200, 260, 90)] for _ in range(3)]
    frames += [[_face(200, 260, 90)] for _ in range(40)]
    positions = [position for position, _ in _follow(frames)]
    assert positions[:3] == [0, 0, 0]
    assert positions[-20:] == [0] * 20


def test_two_sets_of_landmarks_on_one_face_are_one_face() -> None:
    assert _follow([[_face(320, 240), _face(322, 238, 104)]]) == [(0, 0)]


def test_frames_without_a_face_and_with_several() -> None:
    frames = [[], [_face(320, 240)], [], [_face(325, 240)]]
    assert _follow(frames) == [(None, 0), (0, 0), (None, 0), (0, 0)]


def _seen(faces: list[np.ndarray | None], **changes: np.ndarray) -> SeenFaces:
    there = [face for face in faces if face is not None]
    count = np.array([face is not None for face in faces], dtype=np.int64)
    plain = {
        "count": count,
        "clip": np.zeros(len(faces), dtype=np.int64),
        "time_s": np.arange(len(faces)) * 0.04,
        "has_alpha": np.zeros(len(faces), dtype=bool),
        "points": np.array(there) / (WIDTH, HEIGHT),
        "irises": np.array([face[list(IRIS_CENTERS)] for face in there]) / (WIDTH, HEIGHT),
        "iris_sigma": np.full((len(there), 2, 2), 0.02),
        "sharpness": np.ones(len(there)),
    }
    return SeenFaces(**(plain | changes))


def test_the_films_rate_comes_from_its_clock() -> None:
    faces: list[np.ndarray | None] = [_face(300 + 3 * k, 240) for k in range(10)]

    def rate(times_s: np.ndarray, clip: list[int]) -> float | None:
        seen = _seen(faces, time_s=times_s, clip=np.array(clip))
        return followed_face(seen, WIDTH, HEIGHT).frames_per_second

    one, two = [0] * 10, [0] * 5 + [1] * 5
    rounded = np.round(np.arange(10) / 30, 3)  # as WebM and MKV do: steps of 33 and 34 ms
    assert rate(rounded, one) == pytest.approx(30)
    assert rate(rounded % 0.1667, two) == pytest.approx(30, abs=0.2), "each clip begins anew"
    paused = np.arange(10) / 50.0
    paused[4:] += 7.0
    assert rate(paused, one) == pytest.approx(50)
    assert rate(np.full(10, np.nan), one) is None, "pictures in a folder"
    assert rate(np.zeros(10), one) is None


def test_clips_of_several_rates_have_the_longest_ones_and_that_is_told() -> None:
    face: list[np.ndarray | None] = [_face(300, 240)] * 70
    clips = np.repeat([0, 1], [10, 60])
    for longer, told in ((60.0, ["30", "60", "60"]), (30.3, [])):
        times_s = np.concatenate([np.arange(10) / 30, np.arange(60) / longer])
        seen = _seen(face, time_s=times_s, clip=clips)
        found = followed_face(seen, WIDTH, HEIGHT)
        assert found.frames_per_second == pytest.approx(longer)
        assert [number for note in rate_notes(seen) for number in re.findall(r"\d+", note)] == told
    assert rate_notes(_seen(face, time_s=np.full(70, np.nan), clip=clips)) == []


def _played_apart_s(times_s: np.ndarray, frames_per_second: float) -> float:
    """How far apart a frame's own moment and that of a film of one rate are at most."""
    return float(np.abs(times_s - times_s[0] - np.arange(len(times_s)) / frames_per_second).max())


def test_a_film_whose_rate_varies_is_told_with_how_far_its_frames_shift() -> None:
    def notes(times_s: np.ndarray) -> tuple[list[str], float | None]:
        count = len(times_s)
        seen = _seen(
            [_face(300, 240)] * count, time_s=times_s, clip=np.zeros(count, dtype=np.int64)
        )
        return rate_notes(seen), followed_face(seen, WIDTH, HEIGHT).frames_per_second

    dark = np.cumsum([0, *[1 / 30] * 48, *[1 / 15] * 48])  # 1.6 s at 30, then 3.2 s at 15
    (note,), rate = notes(dark)
    assert rate == pytest.approx(20)
    # At 1.6 s comes frame 48, which is shown at 48 / 20 s.
    assert _played_apart_s(dark, 20) == pytest.approx(0.8)
    for told in ("the film's frames", "15 to 30 a second", "up to 0.8 s too", "-vf fps="):
        assert told in note
    for rate in (12.5, 2.0, 0.4):  # One or two frames of slow films are long.
        assert notes(np.delete(np.arange(200) / rate, [90, 91]))[0] == []
    (note,), _ = notes(np.cumsum([0, *[2.5] * 30, *[4.0] * 20]))
    assert "-vf fps=0.4 " in note
    drawn = np.random.default_rng(4)
    even = np.arange(900) / 30
    for times_s in (
        np.round(even, 3),
        np.round(np.arange(900) * 1.001 / 24, 3),
        even + drawn.normal(0, 0.003, 900),  # a telephone's
        even + (even > 10) / 30,  # one frame is left out
        even + 7.0 * (even > 10),  # a pause
    ):
        assert notes(times_s)[0] == []
    # Light that a telephone's rate follows: 24 to 30, slowly.
    followed = np.cumsum(1 / (27 + 3 * np.cos(np.arange(900) / 140)))
    (note,), rate = notes(followed)
    assert rate is not None
    assert f"up to {_played_apart_s(followed, rate):.1f} s too" in note
    several = np.concatenate([np.arange(30) / 30, dark])
    clips = np.repeat([0, 1], [30, len(dark)])
    told_of = rate_notes(_seen([_face(300, 240)] * len(clips), time_s=several, clip=clips))
    assert [note.startswith("clip 2's frames come at a varying rate") for note in told_of] == [
        True,
        False,
    ]


def test_a_long_film_is_looked_through_in_little_more_than_its_landmarks() -> None:
    seen = _seen([_face(300 + k % 7, 240) for k in range(1000)])
    followed_face(seen, WIDTH, HEIGHT)  # the first call prepares the checks of types
    tracemalloc.start()
    found = followed_face(seen, WIDTH, HEIGHT)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found.segments()) == 1
    assert most < 2 * found.points_px.nbytes


def test_gaps_jumps_pauses_and_new_clips_begin_segments() -> None:
    faces: list[np.ndarray | None] = [_face(300 + 3 * k, 240) for k in range(10)]
    plain = followed_face(_seen(faces), WIDTH, HEIGHT)
    assert plain.follows() == [False] + [True] * 9
    assert plain.segments() == [{"first_frame": 0, "last_frame": 9, "clip": 0}]

    gap = followed_face(_seen([*faces[:4], None, *faces[5:]]), WIDTH, HEIGHT)
    assert gap.follows() == [False, True, True, True, False, True, True, True, True]
    assert [part["first_frame"] for part in gap.segments()] == [0, 5]

    moved = [*faces[:6], *(face + 30 for face in faces[6:] if face is not None)]
    jump = followed_face(_seen(moved), WIDTH, HEIGHT)
    assert jump.follows().index(False, 1) == 6

    times = np.arange(10) * 0.04
    times[3:] += 1.0
    assert followed_face(_seen(faces, time_s=times), WIDTH, HEIGHT).follows().index(False, 1) == 3

    clips = np.repeat([0, 1], 5)
    assert followed_face(_seen(faces, clip=clips), WIDTH, HEIGHT).follows().index(False, 1) == 5


def test_slow_motion_and_what_is_none_are_each_followed_at_their_own_rate() -> None:
    faces: list[np.ndarray | None] = [_face(300 + k, 240) for k in range(60)]
    slow, plain = np.arange(40) / 240, np.arange(20) / 30
    clips = np.repeat([0, 1], [40, 20])
    two = followed_face(_seen(faces, time_s=np.concatenate([slow, plain]), clip=clips), 640, 480)
    assert [part["first_frame"] for part in two.segments()] == [0, 40]
    assert two.frames_per_second == pytest.approx(240), "the longer one's"
    # A telephone's film that is slow motion at first.
    times_s = np.concatenate([slow, slow[-1] + (1 + np.arange(20)) / 30])
    assert len(followed_face(_seen(faces, time_s=times_s), 640, 480).segments()) == 1


def test_where_others_sat_in_one_clip_the_person_may_sit_in_the_next() -> None:
    person, other = _face(200, 240), _face(500, 240, 80)
    both = SeenFaces(
        count=np.array([2] * 10 + [1] * 10),
        clip=np.repeat([0, 1], 10),
        time_s=np.arange(20) * 0.04,
        has_alpha=np.zeros(20, dtype=bool),
        points=np.array([person, other] * 10 + [_face(500, 240)] * 10) / (WIDTH, HEIGHT),
        irises=np.full((30, 2, 2), 0.5),
        iris_sigma=np.full((30, 2, 2), 0.02),
        sharpness=np.ones(30),
    )
    found = followed_face(both, WIDTH, HEIGHT)
    assert found.frame_index == tuple(range(20))
    assert found.points_px[:, :, 0].mean(1)[[9, 10]] == pytest.approx([200, 500], abs=30)


def test_a_cut_of_one_person_begins_a_segment_and_a_quick_turn_of_the_head_none() -> None:
    """A shot drawn nearer by a quarter; and a head that sets off, hurries and stops."""
    cut = [_face(300 + k, 240, 120 if k < 6 else 150) for k in range(12)]
    found = followed_face(_seen(cut), WIDTH, HEIGHT)
    assert [part["first_frame"] for part in found.segments()] == [0, 6]
    way = np.cumsum([0, 0, 0, 10, 20, 30, 20, 10, 0, 0])
    turn = followed_face(_seen([_face(200 + x, 240, 120) for x in way]), WIDTH, HEIGHT)
    assert turn.segments() == [{"first_frame": 0, "last_frame": 9, "clip": 0}]
    # A webcam's 10 frames a second in a recording of 30.
    thrice = np.repeat(np.arange(0, 120, 12), 3)
    turn = followed_face(_seen([_face(200 + x, 240, 120) for x in thrice]), WIDTH, HEIGHT)
    assert len(turn.segments()) == 1


def test_no_frame_is_lost_where_a_film_was_cut_and_nobody_else_is_seen() -> None:
    """Talking heads are cut and drawn nearer every few seconds."""
    near, far = _face(480, 300, 160), _face(300, 240)
    shots = [far] * 12 + [near] * 7 + [far] * 9 + [None] * 2 + [near] * 8
    film = followed_face(_seen(shots), WIDTH, HEIGHT)
    assert film.with_others == ()
    assert film.frame_index == (*range(28), *range(30, 38))
    assert [part["first_frame"] for part in film.segments()] == [0, 12, 19, 30]
    faces = np.array([face for face in shots if face is not None])
    np.testing.assert_allclose(film.points_px, faces)
    # A shot of three frames is nobody's yet: another one, as far as can be told.
    flash = followed_face(_seen([far] * 12 + [near] * 3 + [far] * 9), WIDTH, HEIGHT)
    assert flash.frame_index == (*range(12), *range(15, 24))
    assert flash.with_others == (12, 13, 14)


def test_blurred_frames_are_noted_and_kept() -> None:
    faces: list[np.ndarray | None] = [_face(320, 240)] * 9
    sharpness = np.ones(9)
    sharpness[4] = 0.1
    found = followed_face(_seen(faces, sharpness=sharpness), WIDTH, HEIGHT)
    assert found.blurred == (4,)
    assert len(found) == 9


def test_a_face_beside_the_picture_has_no_sharpness() -> None:
    picture = np.random.default_rng(5).integers(0, 255, (90, 120, 3)).astype(np.uint8)
    face = np.clip(SHAPE, -0.5, 0.5) * 0.25
    assert sharpness(picture, face + 0.5) > 0
    for beside in ((-0.2, 0.5), (0.5, -0.2), (-0.2, -0.2), (1.2, 0.5), (0.5, 1.2)):
        assert sharpness(picture, face + beside) == 0, beside


def test_real_faces_that_cross_in_a_picture() -> None:
    pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
    from rgbavatar_ns.tracking.face.detector import FaceLandmarker

    portrait = cv2.resize(astronaut()[:290, 40:330], (200, 200))
    other = np.clip(portrait[:, ::-1].astype(int)[..., ::-1] * 0.9, 0, 255).astype(np.uint8)
    alone = np.full((240, 640, 3), 128, np.uint8)
    alone[20:220, 220:420] = portrait
    with closing(FaceLandmarker()) as landmarker:
        truth = landmarker(alone)
        assert truth is not None
        assert landmarker(alone) is not None
        for left in range(0, 441, 22):
            picture = alone.copy()
            picture[30:230, left : left + 200] = other
            found = landmarker(picture)
            if abs(left - 220) > 190:
                assert found is not None, left
            if found is not None and abs(left - 220) > 150:
                assert np.linalg.norm(found - truth, axis=1).mean() < 8, left
