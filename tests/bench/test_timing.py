import pytest
import torch

from rgbavatar_ns.bench.timing import WHOLE, Spread, Stopwatch, peak_growth_bytes
from rgbavatar_ns.threads import using_threads
from tests.data.streaming import Clock


def test_spread_is_median_and_quartiles():
    spread = Spread.of([0.005, 0.001, 0.003, 0.002, 0.004])
    assert (spread.lower_ms, spread.median_ms, spread.upper_ms) == pytest.approx((2, 3, 4))
    assert spread.repetitions == 5
    assert Spread.of([0.002]) == Spread(2.0, 2.0, 2.0, 1)


def test_the_warm_up_and_what_is_prepared_are_outside_of_the_time():
    clock, calls = Clock(), []

    def call():
        calls.append("call")
        clock.sleep(9.0 if len(calls) == 1 else 0.002)

    spread = Stopwatch(3, clock=clock).time("nothing", call, lambda: clock.sleep(5.0))
    assert len(calls) == 4
    assert spread.repetitions == 3
    assert (spread.lower_ms, spread.upper_ms) == pytest.approx((2, 2))
    assert Stopwatch(1, warm_up=False, clock=clock).time("", call).repetitions == 1
    assert len(calls) == 5


def test_laps_share_out_the_whole():
    clock = Clock()

    def call(lap):
        clock.sleep(0.02)
        lap("first")
        clock.sleep(0.04)
        lap("second")
        clock.sleep(0.01)

    laps = Stopwatch(2, clock=clock).laps("two", call)
    found = [laps[name].median_ms for name in ("first", "second", WHOLE)]
    assert found == pytest.approx([20, 40, 70])


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
