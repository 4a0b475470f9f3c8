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
    local_size, global_size, stream, runs = 3, 5, 23, 1600
    seen = Counter()
    for seed in range(runs):
        pools = LocalGlobalPools(local_size, global_size, seed=seed)
        for frame in range(stream):
            pools.add(frame)
        seen.update(pools.global_frames)
    departed = stream - local_size
    chance = global_size / departed
    # Hoeffding: all of the 20 frequencies lie within this of the truth with probability .999.
    tolerance = np.sqrt(np.log(2 * departed / 1e-3) / (2 * runs))
    assert tolerance < chance / 4
    assert set(seen) == set(range(departed))
    for frame in range(departed):
        assert abs(seen[frame] / runs - chance) < tolerance


@pytest.mark.parametrize(
    ("share", "batch", "local"), [(0.7, 10, 7), (0.5, 8, 4), (0.0, 4, 0), (1.0, 4, 4)]
)
def test_eta_is_the_local_share_of_a_batch(share, batch, local):
    pools = LocalGlobalPools(20, 20, share)
    for frame in range(40):
        pools.add(frame)
    for _ in range(20):
        drawn = pools.batch(batch)
        assert len(set(drawn)) == batch
        assert sum(frame >= 20 for frame in drawn) == local


def test_one_pool_fills_up_for_the_other():
    pools = LocalGlobalPools(local_size=10, global_size=5)
    for frame in range(4):
        pools.add(frame)
    assert sorted(pools.batch(10)) == [0, 1, 2, 3]
    for frame in range(4, 11):
        pools.add(frame)
    drawn = pools.batch(10)
    assert 0 in drawn  # the only frame in the global pool
    assert len(set(drawn)) == 10
    few_local = LocalGlobalPools(local_size=2, global_size=50)
    for frame in range(30):
        few_local.add(frame)
    drawn = few_local.batch(10)
    assert {28, 29} <= set(drawn)
    assert len(set(drawn)) == 10


def test_without_a_global_pool_old_frames_are_gone():
    pools = LocalGlobalPools(local_size=5, global_size=0)
    dropped = [pools.add(frame) for frame in range(8)]
    assert dropped == [None] * 5 + [0, 1, 2]
    assert set(pools.batch(10)) == {3, 4, 5, 6, 7}


def test_pools_go_on_from_their_state_as_if_uninterrupted():
    def stream(pools: LocalGlobalPools, frames: range) -> list[list[int]]:
        batches = []
        for frame in frames:
            pools.add(frame)
            batches.append(pools.batch(6))
        return batches

    whole = LocalGlobalPools(5, 7, seed=4)
    stream(whole, range(30))
    file = io.BytesIO()
    torch.save(whole.state_dict(), file)
    file.seek(0)
    resumed = LocalGlobalPools(5, 7, seed=99)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    assert stream(resumed, range(30, 60)) == stream(whole, range(30, 60))
    assert resumed.global_frames == whole.global_frames


def test_state_of_larger_pools_is_refused():
    large = LocalGlobalPools(5, 7)
    for frame in range(20):
        large.add(frame)
    with pytest.raises(UserError, match="5 and 7"):
        LocalGlobalPools(4, 7).load_state_dict(large.state_dict())


def test_a_batch_before_the_first_frame_is_refused():
    with pytest.raises(UserError, match="No frame"):
        LocalGlobalPools().batch(4)


@pytest.mark.parametrize("wrong", [{"local_size": 0}, {"global_size": -1}, {"local_share": 1.5}])
def test_impossible_pools_are_refused(wrong):
    with pytest.raises(ValueError, match="local_size"):
        LocalGlobalPools(**wrong)
