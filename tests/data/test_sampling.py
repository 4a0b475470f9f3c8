import io
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.data import LocalGlobalPools, OfflineOrder
from rgbavatar_ns.errors import UserError

sizes = st.integers(1, 23).flatmap(lambda n: st.tuples(st.just(n), st.integers(1, n)))


def flat(order: OfflineOrder, steps: int) -> list[int]:
    return [position for step in range(steps) for position in order.batch(step)]


@settings(deadline=None, max_examples=40)
@given(sizes, st.integers(0, 2**40))
def test_every_epoch_shows_every_frame_once(size, seed):
    count, batch_size = size
    positions = range(100, 100 + count)
    drawn = flat(OfflineOrder(positions, batch_size, seed), 5 * count)
    for epoch in range(5):
        assert sorted(drawn[epoch * count : (epoch + 1) * count]) == list(positions)


@settings(deadline=None, max_examples=40)
@given(sizes, st.integers(0, 1000))
def test_frames_of_a_batch_differ(size, seed):
    order = OfflineOrder(range(size[0]), size[1], seed)
    for step in range(25):
        assert len(set(order.batch(step))) == size[1]


@settings(deadline=None, max_examples=40)
@given(sizes, st.lists(st.integers(0, 30), max_size=5))
def test_a_batch_is_a_pure_function_of_seed_and_step(size, steps):
    used = OfflineOrder(range(size[0]), size[1], 3)
    for step in steps:
        fresh = OfflineOrder(range(size[0]), size[1], 3)
        assert used.batch(step) == fresh.batch(step)


def test_seeds_and_epochs_give_different_orders():
    one, other = OfflineOrder(range(50), 10, 1), OfflineOrder(range(50), 10, 2)
    assert flat(one, 5) != flat(other, 5)
    assert flat(one, 5) != flat(one, 10)[50:]


def test_every_place_in_an_epoch_sees_every_frame_equally_often():
    count, epochs = 7, 2000
    drawn = np.array(flat(OfflineOrder(range(count), 3, 0), epochs * count // 3))
    drawn = drawn[: len(drawn) // count * count].reshape(-1, count)
    expected = len(drawn) / count
    for place in range(count):
        seen = np.bincount(drawn[:, place], minlength=count)
        chi_square = ((seen - expected) ** 2 / expected).sum()
        assert chi_square < 22.46  # 6 degrees of freedom: exceeded with probability .001


def test_an_order_of_nothing_or_with_impossible_batches_is_refused():
    with pytest.raises(UserError):
        OfflineOrder((), 1, 0)
    for batch_size in (0, 4):
        with pytest.raises(ValueError, match="out of 3"):
            OfflineOrder(range(3), batch_size, 0)


def filled(pools: LocalGlobalPools, frames: int) -> LocalGlobalPools:
    for frame in range(frames):
        pools.add(frame)
    return pools


def test_local_pool_is_first_in_first_out():
    pools = LocalGlobalPools(local_size=3, global_size=100)
    for frame in range(8):
        pools.add(frame)
        assert pools.local_frames == tuple(range(max(0, frame - 2), frame + 1))
    assert sorted(pools.global_frames) == [0, 1, 2, 3, 4]


def test_pools_never_grow_beyond_their_sizes_and_tell_what_they_drop():
    pools = LocalGlobalPools(local_size=4, global_size=6, seed=2)
    held = set()
    for frame in range(60):
        held.add(frame)
        dropped = pools.add(frame)
        if dropped is not None:
            held.remove(dropped)
        assert held == {*pools.local_frames, *pools.global_frames}
        assert len(pools.local_frames) <= 4
        assert len(pools.global_frames) <= 6
    assert len(pools) == len(held) == 10


def test_every_streamed_frame_is_equally_likely_in_the_global_pool():
    local_size, global_size, stream, runs = 3, 8, 43, 2000
    seen = np.zeros(stream)
    for seed in range(runs):
        pools = LocalGlobalPools(local_size, global_size, seed=seed)
        for frame in range(stream):
            pools.add(frame)
        seen[list(pools.global_frames)] += 1
    departed = stream - local_size
    assert seen[departed:].sum() == 0
    # Each is kept with probability |M_g| / n. Frames of one pool exclude each other: compared with
    # independent draws the statistic is smaller by (1 - |M_g| / n) n / (n - 1).
    expected = runs * global_size / departed
    statistic = ((seen[:departed] - expected) ** 2 / expected).sum()
    statistic /= (1 - global_size / departed) * departed / (departed - 1)
    # Chi-square of 39 degrees of freedom: outside with probability .002.
    assert 17.26 < statistic < 72.05


def test_local_pool_of_the_papers_size_holds_exactly_the_last_150():
    pools = filled(LocalGlobalPools(), 1400)
    assert pools.local_frames == tuple(range(1250, 1400))
    assert len(pools.global_frames) == len(set(pools.global_frames)) == 1000
    assert max(pools.global_frames) < 1250


def test_release_strategy_ramps_the_global_share_up_to_seven_tenths():
    pools = LocalGlobalPools(150, 1000, strategy="release")
    shares = {}
    for frame in range(900):
        pools.add(frame)
        if frame + 1 in (151, 300, 450, 600, 900):
            batch = pools.batch(100)
            shares[frame + 1] = sum(drawn <= frame - 150 for drawn in batch)
    # 70 of 100 after 600 frames, in proportion before; only one frame is there at 151.
    assert shares == {151: 1, 300: 35, 450: 52, 600: 70, 900: 70}


def test_release_strategy_favours_the_newest_as_exp_i_over_150():
    pools = LocalGlobalPools(150, 0, strategy="release", seed=1)
    for frame in range(150):
        pools.add(frame)
    draws = 20_000
    counts = np.bincount([pools.batch(1)[0] for _ in range(draws)], minlength=150)
    weight = np.exp(np.arange(150) / 150)
    expected = draws * weight / weight.sum()
    # Chi-square of 149 degrees of freedom: exceeded with probability .001.
    assert ((counts - expected) ** 2 / expected).sum() < 208.1


def test_new_frames_come_first_newest_first_and_take_half_of_the_local_part():
    pools = filled(LocalGlobalPools(100, 50, new_first=True), 120)
    drawn = pools.batch(10)  # seven local ones: four new first, the rest by chance
    assert drawn[:4] == [119, 118, 117, 116]
    assert len(set(drawn)) == 10
    assert sum(frame >= 20 for frame in drawn) == 7
    # Each new frame is in the very next batch, without being drawn twice in it.
    for frame in range(120, 160):
        pools.add(frame)
        drawn = pools.batch(10)
        assert drawn[0] == frame
        assert len(set(drawn)) == 10


@pytest.mark.parametrize(("share", "local", "new"), [(0.1, 1, 1), (0.3, 3, 2), (0.7, 7, 4)])
def test_new_frames_fill_half_of_the_local_part_rounded_up(share: float, local: int, new: int):
    """As the option's help says it; .3 is the tiny preset's share."""
    by_chance = set[int]()
    for seed in range(20):
        drawn = filled(LocalGlobalPools(100, 50, share, seed, new_first=True), 120).batch(10)
        assert drawn[:new] == list(range(119, 119 - new, -1))
        assert sum(frame >= 20 for frame in drawn) == local
        by_chance |= set(drawn[new:local])
    assert len(by_chance) > 15 or local == new


def test_without_new_first_a_frame_waits_for_chance():
    pools = LocalGlobalPools(100, 50)
    for frame in range(120):
        pools.add(frame)
    assert sum(119 in pools.batch(10) for _ in range(200)) < 60  # expected: 14


@pytest.mark.parametrize(
    ("share", "batch", "local"), [(0.7, 10, 7), (0.5, 8, 4), (0.0, 4, 0), (1.0, 4, 4)]
)
def test_eta_is_the_local_share_of_a_batch(share, batch, local):
    pools = filled(LocalGlobalPools(20, 20, share), 40)
    for _ in range(20):
        drawn = pools.batch(batch)
        assert len(set(drawn)) == batch
        assert sum(frame >= 20 for frame in drawn) == local


def test_evenly_drawn_every_held_frame_is_as_likely():
    pools = LocalGlobalPools(local_size=5, global_size=15, local_share=0.7, seed=3)
    for frame in range(100):
        pools.add(frame)
    drawn = Counter(frame for _ in range(1500) for frame in pools.batch(4, evenly=True))
    assert set(drawn) == {*pools.local_frames, *pools.global_frames}
    # 300 of each are expected; 66 are more than four standard deviations.
    assert all(abs(count - 300) < 66 for count in drawn.values()), drawn
    assert all(len(set(pools.batch(20, evenly=True))) == 20 for _ in range(5))


def test_one_pool_fills_up_for_the_other():
    pools = filled(LocalGlobalPools(local_size=10, global_size=5), 4)
    assert sorted(pools.batch(10)) == [0, 1, 2, 3]
    for frame in range(4, 11):
        pools.add(frame)
    drawn = pools.batch(10)
    assert 0 in drawn  # the only frame in the global pool
    assert len(set(drawn)) == 10
    few_local = filled(LocalGlobalPools(local_size=2, global_size=50), 30)
    drawn = few_local.batch(10)
    assert {28, 29} <= set(drawn)
    assert len(set(drawn)) == 10


def test_without_a_global_pool_old_frames_are_gone():
    pools = LocalGlobalPools(local_size=5, global_size=0)
    dropped = [pools.add(frame) for frame in range(8)]
    assert dropped == [None] * 5 + [0, 1, 2]
    assert set(pools.batch(10)) == {3, 4, 5, 6, 7}


@pytest.mark.parametrize("strategy", ["paper", "release"])
@pytest.mark.parametrize("new_first", [False, True])
def test_pools_go_on_from_their_state_as_if_uninterrupted(strategy, new_first):
    def stream(pools: LocalGlobalPools, frames: range) -> list[list[int]]:
        batches = []
        for frame in frames:
            pools.add(frame)
            batches.append(pools.batch(6))
        return batches

    whole = LocalGlobalPools(5, 7, seed=4, strategy=strategy, new_first=new_first)
    stream(whole, range(30))
    file = io.BytesIO()
    torch.save(whole.state_dict(), file)
    file.seek(0)
    resumed = LocalGlobalPools(5, 7, seed=99, strategy=strategy, new_first=new_first)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    assert stream(resumed, range(30, 60)) == stream(whole, range(30, 60))
    assert resumed.global_frames == whole.global_frames


def test_state_of_larger_pools_is_refused():
    large = filled(LocalGlobalPools(5, 7), 20)
    with pytest.raises(UserError, match="5 and 7"):
        LocalGlobalPools(4, 7).load_state_dict(large.state_dict())


def test_a_batch_before_the_first_frame_is_refused():
    with pytest.raises(UserError, match="No frame"):
        LocalGlobalPools().batch(4)


@pytest.mark.parametrize("wrong", [{"local_size": 0}, {"global_size": -1}, {"local_share": 1.5}])
def test_impossible_pools_are_refused(wrong):
    with pytest.raises(ValueError, match="local_size"):
        LocalGlobalPools(**wrong)
