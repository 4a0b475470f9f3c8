"""What a film lacks is told, that alone, and nothing of a film that has all."""

from dataclasses import replace

import pytest
import torch

from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.data.check.film import FilmFacts, HeadTurns, film_facts
from rgbavatar_ns.data.check.sample import take_sample

from .talking_head import talking_head, with_images


def _turns(*degrees: float) -> HeadTurns:
    """Left, right, up, down."""
    return HeadTurns(*map(float, degrees))


ALL = FilmFacts(1500, _turns(32, 31, 16, 15), 18.0, 4, 0.6, 0.45, 1.1, 300.0, 0.01)
UNKNOWN = FilmFacts(1500, ALL.turns, None, None, None, None, None)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> TrackedDataset:
    return talking_head(tmp_path_factory.mktemp("film") / "data")


def test_a_film_that_has_all_is_told_nothing():
    assert ALL.lacks() == ()
    assert ALL.in_words() == []
    assert ALL.to_json()["lacks"] == []


def test_what_is_not_known_is_not_asked_for():
    assert UNKNOWN.lacks() == ()


@pytest.mark.parametrize(
    ("changes", "what", "advice"),
    [
        ({"turns": _turns(5, 31, 16, 15)}, "turns to its left (5 of 30", "to your left"),
        ({"turns": _turns(31, 0, 16, 15)}, "turns to its right (0 of 30", "to your right"),
        ({"turns": _turns(31, 31, 3, 15)}, "looks up (3 of 15", "raise your chin"),
        ({"turns": _turns(31, 31, 15, 2)}, "looks down (2 of 15", "lower your chin"),
        ({"mouth_open_degrees": 6.0}, "mouth wide open", "open your mouth"),
        ({"blinks": 0}, "a blink", "blink"),
        ({"smile": 0.2}, "a smile", "smile"),
        ({"brightness": 0.05}, "dark", "window"),
        ({"light_ratio": 2.0}, "changes over the film", "exposure"),
        ({"blurred_share": 0.3}, "sharp frames", "slowly"),
        ({"face_height_px": 90.0}, "a large face (90 of 150", "nearer"),
        ({"frames": 75}, "length (75 of 500", "a minute"),
    ],
)
def test_a_film_that_lacks_one_thing_is_told_just_that(changes, what, advice):
    facts = replace(ALL, **changes)
    (lack,) = facts.lacks()
    assert what in lack.what
    assert advice in lack.advice
    told, asked = facts.in_words()
    assert lack.what in told
    assert asked.count(lack.advice) == 1


def _facts(dataset: TrackedDataset) -> FilmFacts:
    return film_facts(dataset, take_sample(dataset, range(len(dataset))))


def _with(dataset: TrackedDataset, frames: slice, **values: float) -> TrackedDataset:
    """These expressions (both sides) and the jaw in these frames, and 0 in all others."""
    theta, layout = dataset.theta.clone(), dataset.layout
    first, names = layout.slice("expression").start, dataset.arrays.expression_names
    theta[:, layout.slice("expression")] = 0
    theta[:, layout.slice("jaw")] = 0
    for name, value in values.items():
        sides = [layout.slice("jaw").start]
        if name != "jaw":
            sides = [first + names.index(name + side) for side in ("Left", "Right")]
        theta[frames, min(sides)] = value
        theta[frames, max(sides)] = value
    return replace(dataset, theta=theta)


def test_mouth_smile_and_blinks_are_read_from_theta(good):
    still = _facts(_with(good, slice(0, 0), eyeBlink=0.0))
    assert (still.blinks, still.smile) == (0, 0)
    half = slice(0, len(good) // 2)
    assert _facts(_with(good, half, mouthSmile=0.7)).smile == pytest.approx(0.7)
    wide = _facts(_with(good, half, jaw=0.25)).mouth_open_degrees
    assert wide == pytest.approx(torch.tensor(0.25).rad2deg().item(), rel=1e-3)
    twice = _with(good, slice(2, 9, 4), eyeBlink=0.9)
    assert _facts(twice).blinks == 2
    assert _facts(_with(good, slice(2, 9), eyeBlink=0.9)).blinks == 1


def test_light_is_that_of_the_person(good, tmp_path):
    steady = _facts(good)
    assert steady.light_ratio is not None
    assert steady.light_ratio < 1.4

    def dimmed(name, factors):
        left = iter(factors)

        def change(image):
            image = image.copy()
            image[..., :3] = (image[..., :3] * next(left)).astype(image.dtype)
            return image

        return _facts(with_images(good, tmp_path / name, change))

    count = len(good)
    dark = dimmed("dark", [0.25] * count)
    assert dark.brightness == pytest.approx(0.25 * (steady.brightness or 0), rel=0.05)
    assert dark.light_ratio == pytest.approx(steady.light_ratio, rel=0.05)
    changing = dimmed("changing", [0.4 if number < count // 2 else 1.0 for number in range(count)])
    assert (changing.light_ratio or 0) > 2
