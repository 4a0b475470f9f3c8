import time

import pytest
import torch

from rgbavatar_ns.bench.timing import WHOLE, Spread, Stopwatch, peak_growth_bytes, using_threads


def test_spread_is_median_and_quartiles():
    spread = Spread.of([0.005, 0.001, 0.003, 0.002, 0.004])
    assert (spread.lower_ms, spread.median_ms, spread.upper_ms) == pytest.approx((2, 3, 4))
    assert spread.repetitions == 5
    assert Spread.of([0.002]) == Spread(2.0, 2.0, 2.0, 1)


def test_the_warm_up_and_what_is_prepared_are_outside_of_the_time():
    calls = []

    def call():
        calls.append("call")
        time.sleep(0.3 if len(calls) == 1 else 0.0)

    spread = Stopwatch(3).time("nothing", call, lambda: time.sleep(0.1))
    assert len(calls) == 4
    assert spread.repetitions == 3
    assert spread.upper_ms < 50


def test_laps_share_out_the_whole():
    def call(lap):
        time.sleep(0.02)
        lap("first")
        time.sleep(0.04)
        lap("second")

    laps = Stopwatch(1).laps("two", call)
    assert laps["first"].median_ms >= 20
    assert laps["second"].median_ms >= 40
    parts = laps["first"].median_ms + laps["second"].median_ms
    assert laps[WHOLE].median_ms == pytest.approx(parts, abs=5)


def test_progress_goes_to_the_end():
    told = []
    Stopwatch(2, lambda *state: told.append(state)).time("work", lambda: None)
    assert told[0] == ("work", 0, 2)
    assert told[-1] == ("work", 2, 2)


def test_memory_that_is_touched_and_given_back_is_seen():
    size = 64 << 20
    growth = peak_growth_bytes(lambda: torch.ones(size, dtype=torch.uint8))
    if growth is None:
        pytest.skip("this system does not tell the peak of a process's memory")
    assert growth == pytest.approx(size, rel=0.15)


def test_threads_are_put_back():
    before = torch.get_num_threads()
    with using_threads(1) as used:
        assert used == torch.get_num_threads() == 1
    assert torch.get_num_threads() == before
    with using_threads(None) as used:
        assert used == before
