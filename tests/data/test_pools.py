"""The pools with their frames: the right pictures, bounded memory, and resuming."""

import dataclasses
import io
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import LocalGlobalPools
from rgbavatar_ns.data.streams import ReplayBuffer, ReplayStream
from rgbavatar_ns.errors import UserError
from tests.data.small_dataset import small_dataset
from tests.data.streaming import HEAD, cheap, streamed, subject, tracked


def pools(local: int = 3, old: int = 4, seed: int = 0, keep_png: bool = True, **clock: Any):
    return ReplayBuffer(subject(), LocalGlobalPools(local, old, seed=seed), keep_png, **clock)


def fill(frames: ReplayBuffer, indices: range, arrived_s: float = 0.0) -> None:
    for index in indices:
        one = dataclasses.replace(streamed(index), arrived_s=arrived_s)
        frames.add(tracked(index), one)


def saved(state: dict[str, Any]) -> dict[str, Any]:
    """As a checkpoint gives it back."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def test_every_drawn_frame_brings_its_own_picture_theta_and_camera():
    frames = pools()
    fill(frames, range(30))
    drawn = set()
    for _ in range(40):
        batch = frames.batch(5)
        assert len(set(batch.serial)) == len(batch.serial) == 5
        for row, serial in enumerate(batch.serial):
            truth = tracked(serial)
            assert np.array_equal(batch.images_rgba[row].numpy(), truth.image_rgba)
            assert torch.equal(batch.theta[row], truth.theta)
            camera = batch.cameras.world_to_camera[row]
            assert torch.equal(camera, truth.camera.world_to_camera[0])
            assert torch.equal(batch.cameras.focal_px[row], truth.camera.focal_px[0])
        drawn |= set(batch.serial)
    # The three newest and four of the others.
    assert {27, 28, 29} <= drawn
    assert len(drawn) == 7
    assert frames.fill == (3, 4)


def test_newest_and_recent_frames():
    now_s = 100.0
    frames = pools(now=lambda: now_s)
    assert frames.newest() is None
    assert frames.newest_theta() is None
    assert frames.recent(1.0, 2) is None
    assert not frames.wait(0.0)
    fill(frames, range(8), arrived_s=98.5)
    fill(frames, range(8, 10), arrived_s=99.5)
    assert frames.wait(0.0)
    newest, theta = frames.newest(), frames.newest_theta()
    assert newest is not None
    assert theta is not None
    assert newest.serial == (9,)
    assert torch.equal(theta, tracked(9).theta)
    for seconds, most, serials in ((60.0, 2, (9, 7)), (60.0, 3, (9, 8, 7)), (1.0, 3, (9, 8))):
        recent = frames.recent(seconds, most)
        assert recent is not None
        assert recent.serial == serials
    now_s = 101.0
    assert frames.recent(1.0, 2) is None


def test_latency_is_from_arrival_to_the_first_batch():
    now_s = 100.05
    frames = pools(local=10, now=lambda: now_s)
    assert frames.median_latency_s() is None
    fill(frames, range(4), arrived_s=100.0)
    frames.batch(4)
    assert frames.median_latency_s() == pytest.approx(0.05)
    now_s = 100.25
    frames.batch(4)  # the same frames again: no first use
    assert frames.median_latency_s() == pytest.approx(0.05)


def test_memory_stays_flat_over_thousands_of_frames():
    frames = ReplayBuffer(subject(), LocalGlobalPools(150, 1000), keep_png=True)
    one, wire = cheap(0)

    def stream(count: int) -> int:
        for _ in range(count):
            frames.add(one, wire)
            if frames.num_added % 200 == 0:
                frames.batch(10)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before_kib = stream(4_000)
    after_kib = stream(20_000)
    assert frames.num_added == 24_000
    assert frames.fill == (150, 1000)
    # Were every frame kept, 384 bytes of pixels and 280 of theta each would be 13 MB.
    assert after_kib - before_kib < 6 * 1024


@pytest.mark.parametrize("keep_png", [True, False])
def test_pools_go_on_from_a_checkpoint_as_they_were(keep_png: bool, tmp_path: Path):
    stream = ReplayStream(small_dataset(tmp_path / "data", HEAD, per_frame_camera=True))
    whole = pools(2, 2, seed=3, keep_png=keep_png)
    fill(whole, range(6))
    whole.batch(3)
    state = saved(whole.state_dict())
    assert ("png" in state) is keep_png
    resumed = pools(2, 2, seed=99, keep_png=keep_png)
    resumed.load_state_dict(state, None if keep_png else stream)
    assert resumed.num_added == 6
    for _ in range(5):
        one, other = whole.batch(3), resumed.batch(3)
        assert one.serial == other.serial
        assert torch.equal(one.images_rgba, other.images_rgba)
        assert torch.equal(one.theta, other.theta)
    fill(whole, range(6, 20))
    fill(resumed, range(6, 20))
    assert whole.thetas()[1] == resumed.thetas()[1]
    assert torch.equal(whole.thetas()[0], resumed.thetas()[0])


def test_a_checkpoint_without_images_needs_its_stream():
    whole = pools(keep_png=False)
    fill(whole, range(3))
    with pytest.raises(UserError, match="holds no images"):
        pools().load_state_dict(whole.state_dict())


def test_a_checkpoint_of_another_image_size_is_refused():
    whole = pools()
    fill(whole, range(3))
    other = ReplayBuffer(subject(width=24), LocalGlobalPools(3, 4))
    with pytest.raises(UserError, match="24 x 8"):
        other.load_state_dict(whole.state_dict())


def test_held_frames_come_in_order_with_their_images():
    for keep_png in (True, False):
        frames = pools(keep_png=keep_png)
        fill(frames, range(12))
        held = frames.held()
        assert len(held) == 7
        assert [serial for serial, _ in held] == sorted(serial for serial, _ in held)
        for serial, frame in held:
            assert np.array_equal(frame.decode().image_rgba, tracked(serial).image_rgba)
