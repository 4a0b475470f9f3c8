"""The pools with their frames: the right pictures, bounded memory, and resuming."""

import dataclasses
import io
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import LocalGlobalPools, load_dataset
from rgbavatar_ns.data.png import decode_png_rgba
from rgbavatar_ns.data.streams import ReplayBuffer, ReplayStream, StreamedFrame
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from tests.data.small_dataset import WIDTH, small_dataset, small_writer
from tests.data.streaming import HEAD, Clock, cheap, streamed, subject, tracked


def pools(local: int = 3, old: int = 4, seed: int = 0, **more: Any) -> ReplayBuffer:
    return ReplayBuffer(subject(), LocalGlobalPools(local, old, seed=seed), **more)


def fill(frames: ReplayBuffer, indices: range, encode: bool = True) -> None:
    for index in indices:
        frames.add(streamed(index, arrived_s=10.0 * index, encode=encode))


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


@pytest.mark.parametrize("encode", [True, False], ids=["PNG", "pixels"])
def test_marks_of_what_nobody_filmed_pass_through_pools_and_checkpoints(encode):
    image = tracked(0).image_rgba
    image[5:] = UNFILMED_RGBA
    frames = pools()
    frames.add(streamed(0, image=image, encode=encode))
    later = pools()
    later.load_state_dict(frames.state_dict())
    for some in (frames, later):
        assert np.array_equal(some.batch(1).images_rgba[0].numpy(), image)


@pytest.mark.parametrize("version", [1, 3])
def test_a_replayed_dataset_means_what_its_version_says(tmp_path, version):
    """At once, and when a run goes on from a checkpoint without images."""
    image = tracked(0).image_rgba
    image[5:] = UNFILMED_RGBA
    writer = small_writer(tmp_path, HEAD)
    writer.add(dataclasses.replace(tracked(0), image_rgba=image))
    writer.finish(0)
    index = tmp_path / "dataset.json"
    index.write_text(index.read_text().replace('"version": 3', f'"version": {version}'))
    dataset = load_dataset(tmp_path)
    frames = pools(save_images=False)
    frames.add(ReplayStream(dataset).again(0))
    later = pools(save_images=False)
    later.load_state_dict(frames.state_dict(), ReplayStream(dataset))
    if version < 3:
        image[5:] = 0
    for some in (frames, later):
        assert np.array_equal(some.batch(1).images_rgba[0].numpy(), image)


@pytest.mark.parametrize("encode", [True, False], ids=["PNG", "pixels"])
def test_a_held_frame_marks_what_nobody_filmed_only_where_its_source_does(encode):
    image = tracked(0).image_rgba
    image[5:] = UNFILMED_RGBA
    frames = pools()
    frames.add(streamed(0, encode=encode))
    frames.add(streamed(1, image=image, encode=encode))
    if encode:
        by_chance = dataclasses.replace(streamed(2, image=image), marks_unfilmed=False)
        frames.add(by_chance)
    held = [frame for _, frame in frames.held()]
    assert [frame.marks_unfilmed for frame in held] == [False, True, False][: len(held)]
    assert np.array_equal(decode_png_rgba(held[1].encoded(), ""), image)
    if encode:
        image[5:] = 0
        assert np.array_equal(decode_png_rgba(held[2].encoded(), ""), image)


def test_newest_and_recent_frames():
    clock = Clock()
    frames = pools(clock=clock)
    assert frames.newest_theta() is None
    assert frames.recent(1.0, 2) is None
    assert not frames.wait(0.0)
    fill(frames, range(10))
    assert frames.wait(0.0)
    theta = frames.newest_theta()
    assert theta is not None
    assert torch.equal(theta, tracked(9).theta)
    clock.now_s = 91.0
    recent = frames.recent(60.0, 2)
    assert recent is not None
    assert recent.serial == (9, 7)
    assert frames.recent(0.9, 2) is None


def test_watched_frames_come_in_turn_and_change_no_draw():
    def filled() -> ReplayBuffer:
        frames = pools(local=8, old=2, clock=lambda: 0.0)
        assert frames.watched(3, -1, 2) is None
        fill(frames, range(7, 15))
        return frames

    watched, plain = filled(), filled()
    seen, after = [], -1
    for _ in range(3):
        batch = watched.watched(3, after, 2)
        assert batch is not None
        seen.append(batch.serial)
        after = batch.serial[-1]
        # The stream's third frame is the one that its source calls 10.
        assert batch.index == tuple(7 + serial for serial in batch.serial)
    assert seen == [(0, 3), (6, 0), (3, 6)]
    assert watched.median_latency_s() is None
    assert [watched.batch(4).serial for _ in range(5)] == [plain.batch(4).serial for _ in range(5)]


def test_latency_is_from_arrival_to_the_first_batch():
    clock = Clock()
    frames = pools(local=10, clock=clock)
    assert frames.median_latency_s() is None
    fill(frames, range(3))  # they arrive at 0, 10 and 20 s
    clock.now_s = 25.0
    frames.batch(3)
    assert frames.median_latency_s() == 15.0
    clock.now_s = 30.0
    frames.batch(3)  # the same frames again: no first use
    assert frames.median_latency_s() == 15.0


def test_memory_stays_flat_however_many_frames_come():
    large = subject(width=64, height=64)
    frames = ReplayBuffer(large, LocalGlobalPools(150, 500))
    one = dataclasses.replace(cheap(0), image_rgba=np.zeros((64, 64, 4), np.uint8))

    def stream(count: int) -> int:
        for _ in range(count):
            frames.add(one)
            if frames.num_added % 200 == 0:
                frames.batch(10)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before_kib = stream(2_000)
    after_kib = stream(8_000)
    assert frames.num_added == 10_000
    assert frames.fill == (150, 500)
    # Were every frame kept, its 16 KiB of pixels would make 128 MiB.
    assert after_kib - before_kib < 16 * 1024


@pytest.mark.parametrize(("save_images", "encode"), [(True, True), (True, False), (False, True)])
def test_pools_go_on_from_a_checkpoint_as_they_were(
    save_images: bool, encode: bool, tmp_path: Path
):
    stream = ReplayStream(small_dataset(tmp_path / "data", HEAD, per_frame_camera=True))
    whole = pools(2, 2, seed=3, save_images=save_images)
    fill(whole, range(6), encode)
    whole.batch(3)
    assert ("png" in whole.state_dict()) is save_images
    file = io.BytesIO()
    torch.save(whole.state_dict(), file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    resumed = pools(2, 2, seed=99, save_images=save_images)
    resumed.load_state_dict(state, None if save_images else stream)
    assert resumed.num_added == 6
    for _ in range(5):
        one, other = whole.batch(3), resumed.batch(3)
        assert one.serial == other.serial
        assert torch.equal(one.images_rgba, other.images_rgba)
        assert torch.equal(one.theta, other.theta)
    fill(whole, range(6, 20), encode)
    fill(resumed, range(6, 20), encode)
    assert whole.parameters()[2] == resumed.parameters()[2]
    assert torch.equal(whole.parameters()[0], resumed.parameters()[0])


@pytest.mark.parametrize(
    ("save_images", "width", "told"), [(False, WIDTH, "holds no images"), (True, 24, "24 x 8")]
)
def test_a_checkpoint_without_images_or_of_another_size_is_refused(save_images, width, told):
    whole = pools(save_images=save_images)
    fill(whole, range(3))
    other = ReplayBuffer(subject(width=width), LocalGlobalPools(3, 4))
    with pytest.raises(UserError, match=told):
        other.load_state_dict(whole.state_dict())


@pytest.mark.parametrize("save_images", [True, False])
@pytest.mark.parametrize("encode", [True, False])
def test_held_frames_come_in_order_with_their_images(save_images: bool, encode: bool):
    frames = pools(save_images=save_images)
    fill(frames, range(12), encode)
    held = frames.held()
    assert len(held) == 7
    assert [serial for serial, _ in held] == sorted(serial for serial, _ in held)
    for serial, frame in held:
        assert np.array_equal(decode_png_rgba(frame.encoded(), ""), tracked(serial).image_rgba)


def test_all_that_is_held_comes_once_in_order_in_batches():
    frames = pools()
    fill(frames, range(12), False)
    batches = list(frames.in_order(3))
    assert [len(batch.serial) for batch in batches] == [3, 3, 1]
    assert [serial for batch in batches for serial in batch.serial] == [
        serial for serial, _ in frames.held()
    ]
    for batch in batches:
        for serial, theta, image in zip(batch.serial, batch.theta, batch.images_rgba):
            assert torch.equal(theta, tracked(serial).theta)
            assert np.array_equal(image, tracked(serial).image_rgba)


def test_a_frame_has_its_image_once():
    one = tracked(0)
    for both in ({}, {"png": b"", "image_rgba": one.image_rgba}):
        with pytest.raises(ValueError, match="either"):
            StreamedFrame(0, one.theta, one.camera, 0.0, **both)
