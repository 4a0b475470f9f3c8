"""What each hair style shows, seen on the true surface and in small renders."""

from functools import cache

import numpy as np
import torch

from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson
from rgbavatar_ns.synthetic.performer.hair import HairStyle

SIZE = 96


@cache
def _person(style: HairStyle) -> DemoPerson:
    config = DemoConfig(
        image_size=SIZE, num_frames=1, num_test_frames=0, glasses=False, supersampling=1, hair=style
    )
    return DemoPerson.of(config)


@cache
def _portrait(style: HairStyle) -> np.ndarray:
    """The person at rest, a little lower so that nothing on the head leaves the image."""
    person = _person(style)
    theta = torch.zeros(1, person.head.layout.size)
    theta[0, person.head.layout.slice("translation").start + 1] = -0.03
    return next(iter(person.draw(theta)))


def _covered(style: HairStyle) -> np.ndarray:
    return _portrait(style)[..., 3] > 127


def test_a_bald_head_lies_within_every_other_one() -> None:
    bald = _covered("bald")
    for style in ("short", "long", "bun", "hat"):
        assert not (bald & ~_covered(style)).any(), style
        assert _covered(style).sum() > bald.sum() + 40, style


def test_each_style_shows_where_it_should() -> None:
    top = {style: int(np.flatnonzero(_covered(style).any(1))[0]) for style in ("short", "bun")}
    assert top["bun"] < top["short"], "a bun stands above the head"
    middle = SIZE // 2
    beside = slice(middle + 8, middle + 16)  # rows of mouth and chin, 3 cm below the eyes on
    width = {style: _covered(style)[beside].sum(1).mean() for style in ("short", "long")}
    assert width["long"] > 1.2 * width["short"], "long hair hangs beside the cheeks"
    brim = slice(middle - 22, middle - 8)
    assert _covered("hat")[brim].sum(1).max() > 1.3 * _covered("short")[brim].sum(1).max()


def test_the_face_stays_free_and_a_bald_scalp_is_skin() -> None:
    middle, half = SIZE // 2, 5
    nose = np.s_[middle + 4 : middle + 12, middle - half : middle + half, :3]
    for style in ("long", "bun"):
        away = _portrait(style)[nose].astype(int) - _portrait("short")[nose].astype(int)
        assert np.abs(away).mean() < 12, style
    crown = int(np.flatnonzero(_covered("bald").any(1))[0]) + 8
    bright = {style: _portrait(style)[crown, middle, :3].mean() for style in ("bald", "short")}
    assert bright["bald"] > 1.5 * bright["short"]
