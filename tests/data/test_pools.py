"""The pools with their frames: the right pictures, bounded memory, and resuming."""

import io
import resource
import time
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


def pools(local: int = 3, old: int = 4, seed: int = 0, save_images: bool = True) -> ReplayBuffer:
    return ReplayBuffer(subject(), LocalGlobalPools(local, old, seed=seed), save_images)


def fill(frames: ReplayBuffer, indices: range) -> None:
    for index in indices:
        frames.add(streamed(index))


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
    frames = pools()
    assert frames.newest() is None
    assert frames.newest_theta() is None
    assert frames.recent(1.0, 2) is None
    assert not frames.wait(0.0)
    fill(frames, range(10))
    assert frames.wait(0.0)
    newest, theta = frames.newest(), frames.newest_theta()
    assert newest is not None
    assert theta is not None
    assert newest.serial == (9,)
    assert torch.equal(theta, tracked(9).theta)
    recent = frames.recent(60.0, 2)
    assert recent is not None
    assert recent.serial == (9, 7)
    time.sleep(0.01)
    assert frames.recent(0.001, 2) is None


def test_latency_is_from_arrival_to_the_first_batch():
    frames = pools(local=10)
    assert frames.median_latency_s() is None
    fill(frames, range(4))
    time.sleep(0.05)
    frames.batch(4)
    first = frames.median_latency_s()
    assert first is not None
    assert 0.05 <= first < 5.0
    time.sleep(0.2)
    frames.batch(4)  # the same frames again: no first use
    assert frames.median_latency_s() == first


def test_memory_stays_flat_over_an_hour_of_frames():
    frames = ReplayBuffer(subject(), LocalGlobalPools(150, 1000))
    one = cheap(0)

    def stream(count: int) -> int:
        for _ in range(count):
            frames.add(one)
            if frames.num_added % 200 == 0:
                frames.batch(10)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before_kib = stream(10_000)
    after_kib = stream(90_000)
    assert frames.num_added == 100_000
    assert frames.fill == (150, 1000)
    # Were every frame kept, 384 bytes of pixels and 280 of theta each would be 60 MB.
    assert after_kib - before_kib < 6 * 1024


@pytest.mark.parametrize("save_images", [True, False])
def test_pools_go_on_from_a_checkpoint_as_they_were(save_images: bool, tmp_path: Path):
    stream = ReplayStream(small_dataset(tmp_path / "data", HEAD, per_frame_camera=True))
    whole = pools(2, 2, seed=3, save_images=save_images)
    fill(whole, range(6))
    whole.batch(3)
    state = saved(whole.state_dict())
    assert ("png" in state) is save_images
    resumed = pools(2, 2, seed=99, save_images=save_images)
    resumed.load_state_dict(state, None if save_images else stream)
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
    whole = pools(save_images=False)
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
    for save_images in (True, False):
        frames = pools(save_images=save_images)
        fill(frames, range(12))
        held = frames.held()
        assert len(held) == 7
        assert [serial for serial, _ in held] == sorted(serial for serial, _ in held)
        for serial, frame in held:
            assert np.array_equal(frame.decode().image_rgba, tracked(serial).image_rgba)
