import numpy as np
import pytest

from rgbavatar_ns.head import EMBEDDED_BUST, HeadModel
from rgbavatar_ns.head.arrays import NECK_SHIFTS
from rgbavatar_ns.synthetic.performer.performance import (
    EARLY_ONLY,
    MOUTH_MOODS,
    perform,
    with_tracker_noise,
)
from rgbavatar_ns.synthetic.performer.wrinkles import WRINKLES, wrinkle_activations

HEAD = HeadModel.embedded()
NAMES = HEAD.arrays.expression_names
LAYOUT = HEAD.layout


@pytest.fixture(scope="module", params=[0, 5])
def theta(request) -> np.ndarray:
    return perform(LAYOUT, NAMES, 240, 60, 8.0, request.param)


def field(theta: np.ndarray, name: str) -> np.ndarray:
    return theta[:, LAYOUT.slice(name)]


def test_everything_moves_within_its_range(theta):
    expression = field(theta, "expression")
    assert expression.min() >= 0
    assert expression.max() <= 1
    yaw = np.degrees(field(theta, "neck")[:, 1])
    assert yaw.max() > 18
    assert yaw.min() < -18
    assert np.abs(yaw).max() <= 26
    assert field(theta, "jaw")[:, 0].max() > 0.2
    assert (field(theta, "jaw")[:, 1:] == 0).all()
    assert np.ptp(field(theta, "left_eye")[:, 1]) > 0.2
    blinks = expression[:, NAMES.index("eyeBlinkLeft")] > 0.8
    assert 6 < blinks.sum() < 60
    assert np.abs(field(theta, "translation")).max() < 0.02


def test_the_head_moves_smoothly(theta):
    degrees_a_frame = np.abs(np.diff(np.degrees(field(theta, "neck")), axis=0)).max()
    assert degrees_a_frame < 11  # at eight frames a second


def test_every_wrinkle_is_seen_folded_and_flat_in_training(theta):
    folds = wrinkle_activations(field(theta, "expression")[:180], NAMES)
    for group, values in zip(WRINKLES, folds.T):
        assert values.max() > 0.7, group
        assert (values < 0.05).mean() > 0.2, group


def test_some_moods_come_early_and_then_only_held_out(theta):
    expression = field(theta, "expression")
    for mood in EARLY_ONLY:
        main = next(iter(MOUTH_MOODS[mood])).replace("*", "Left")
        values = expression[:, NAMES.index(main)]
        assert values[:70].max() > 0.5
        assert values[85:180].max() == 0
        assert values[180:].max() > 0.5


def test_no_held_out_frame_was_trained_on(theta):
    distance = np.abs(theta[180:, None] - theta[None, :180]).max(-1).min(1)
    assert np.median(distance) > 0.1


def test_a_seed_gives_one_performance():
    first, again, other = (perform(LAYOUT, NAMES, 30, 5, 10.0, seed) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_noise_has_the_strength_asked_for():
    theta = np.full((3000, LAYOUT.size), 0.5)
    assert np.array_equal(with_tracker_noise(theta, LAYOUT, NAMES, 0.0, 3), theta)
    error = with_tracker_noise(theta, LAYOUT, NAMES, 2.0, 3) - theta
    assert np.std(error[:, LAYOUT.slice("expression")]) == pytest.approx(0.020, rel=0.05)
    assert np.std(error[:, LAYOUT.slice("neck")]) == pytest.approx(0.0036, rel=0.1)
    assert np.std(error[:, LAYOUT.slice("translation")]) == pytest.approx(2e-4, rel=0.1)


def test_noise_never_makes_an_expression_negative():
    noisy = with_tracker_noise(np.zeros((50, LAYOUT.size)), LAYOUT, NAMES, 1.0, 0)
    assert noisy[:, LAYOUT.slice("expression")].min() >= 0
    assert noisy[:, LAYOUT.slice("neck")].min() < 0


def test_noise_leaves_the_sign_of_a_neck_s_shifts():
    """They are centimetres, not coefficients: cut off at zero the skull was 2 mm off."""
    bust = HeadModel.embedded(name=EMBEDDED_BUST)
    names, layout = bust.arrays.expression_names, bust.layout
    true = perform(layout, names, 240, 60, 8.0, 0, "lean")
    found = with_tracker_noise(true, layout, names, 1.0, 0)
    columns = [layout.slice("expression").start + names.index(name) for name in NECK_SHIFTS]
    assert (true[:, columns].min(0) < -0.1).all()
    assert np.abs(found - true)[:, columns].max() < 0.06
