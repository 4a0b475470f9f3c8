import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.driving import OneEuroOptions, one_euro
from rgbavatar_ns.errors import UserError

_RATE = 25.0


@settings(max_examples=8, deadline=None)
@given(st.floats(-5, 5), st.integers(0, 40))
def test_a_constant_stays(value, count):
    steady = torch.full((count, 3), value, dtype=torch.float64)
    assert torch.equal(one_euro(steady, _RATE), steady)


@settings(max_examples=8, deadline=None)
@given(st.floats(0.05, 4), st.floats(0.3, 5), st.floats(0, 5))
def test_the_lag_on_a_steady_motion_is_bounded_by_the_cutoff_at_rest(speed, cutoff_hz, beta):
    seconds = torch.arange(150, dtype=torch.float64) / _RATE
    ramp = (speed * seconds)[:, None]
    lag = ramp - one_euro(ramp, _RATE, OneEuroOptions(cutoff_hz, beta))
    time_constant = 1 / (2 * math.pi * cutoff_hz)
    assert (lag >= -1e-12).all(), "it looks back only"
    assert lag.max() <= speed * time_constant * (1 + 1e-9)
    if beta == 0:
        # An exponential average lags by its time constant; one frame's step is already in.
        assert lag[-1].item() == pytest.approx(speed * time_constant, rel=1e-2)


def test_jitter_is_reduced_and_more_so_with_a_lower_cutoff():
    noise = 0.01 * torch.randn(200, 4, generator=torch.Generator().manual_seed(0))
    spread = [
        one_euro(noise, _RATE, OneEuroOptions(cutoff_hz, 0.5))[50:].std().item()
        for cutoff_hz in (0.5, 1.5, 5.0)
    ]
    assert spread == sorted(spread)
    assert spread[1] < 0.5 * noise.std()


def test_fast_motion_lags_less_with_beta_and_columns_do_not_mix():
    step = torch.zeros(60, 2)
    step[20:, 0] = 1
    slow, quick = (one_euro(step, _RATE, OneEuroOptions(1.0, beta)) for beta in (0.0, 5.0))
    assert quick[24, 0] > slow[24, 0] + 0.1
    assert not quick[:, 1].any()


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000), st.floats(-3, 3))
def test_a_shift_passes_through(seed, shift):
    values = torch.randn(30, 2, generator=torch.Generator().manual_seed(seed)).double()
    assert torch.allclose(one_euro(values + shift, _RATE), one_euro(values, _RATE) + shift)


def test_what_lies_beyond_a_gap_is_smoothed_by_itself():
    values = torch.randn(30, 2, generator=torch.Generator().manual_seed(3)).double()
    moments = [*range(12), *range(30, 48)]
    apart = [one_euro(values[part], _RATE) for part in (slice(0, 12), slice(12, 30))]
    assert torch.equal(one_euro(values, _RATE, moments=moments), torch.cat(apart))


def test_every_other_frame_is_smoothed_as_a_film_of_half_the_rate():
    values = torch.randn(30, 2, generator=torch.Generator().manual_seed(4)).double()
    there = one_euro(values, _RATE, moments=range(7, 67, 2))
    assert torch.allclose(there, one_euro(values, _RATE / 2), rtol=0, atol=1e-12)


def test_no_filter_is_refused():
    for wrong in ({"min_cutoff_hz": 0.0}, {"beta": -1.0}, {"derivative_cutoff_hz": 0.0}):
        with pytest.raises(UserError, match="Give a number from"):
            OneEuroOptions(**wrong)
