"""Batches of different training frames with their own theta and camera; held-out ones apart."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar.prior import NUM_VIEWS
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.plugin.cameras import from_nerfstudio
from rgbavatar_ns.plugin.datamanager import (
    RGBAvatarDataManager,
    RGBAvatarDataManagerConfig,
    device_budget,
)
from tests.plugin.tiny import NUM_FRAMES, NUM_TEST, SIZE, tiny_dataset


@pytest.fixture(scope="module")
def datamanager(tiny_data: Path) -> RGBAvatarDataManager:
    return RGBAvatarDataManagerConfig(data=tiny_data, batch_size=4, seed=5).setup(device="cpu")


def test_last_frames_are_held_out(datamanager: RGBAvatarDataManager):
    assert len(datamanager.train_dataset) == NUM_FRAMES - NUM_TEST
    assert len(datamanager.eval_dataset) == NUM_TEST
    names = [path.name for path in datamanager.eval_dataset.image_filenames]
    assert names == [f"{i:05d}.png" for i in range(NUM_FRAMES - NUM_TEST, NUM_FRAMES)]


def test_a_batch_is_different_frames_with_their_own_images_cameras_and_theta(
    datamanager: RGBAvatarDataManager, tiny_data: Path
):
    tracked = load_dataset(tiny_data)
    for step in range(6):
        cameras, batch = datamanager.next_train(step)
        positions = batch["position"]
        assert len(set(positions)) == 4
        assert set(positions) <= set(tracked.train)
        assert batch["image"].dtype == torch.uint8
        assert batch["image"].shape == (4, SIZE, SIZE, 4)
        for i, position in enumerate(positions):
            assert np.array_equal(batch["image"][i].numpy(), tracked.read_image(position))
        assert cameras.metadata is not None
        assert torch.equal(cameras.metadata["theta"], tracked.theta[positions])
        assert len(torch.unique(cameras.metadata["background"], dim=0)) == 4
        seen = from_nerfstudio(cameras).world_to_camera
        expected = tracked.cameras.world_to_camera.expand(len(tracked), 4, 4)[positions]
        torch.testing.assert_close(seen, expected, atol=1e-6, rtol=0)


def test_an_epoch_sees_every_training_frame_once(tiny_data: Path):
    # 11 training frames in batches of 11: one epoch a step.
    config = RGBAvatarDataManagerConfig(data=tiny_data, batch_size=NUM_FRAMES - NUM_TEST, seed=1)
    datamanager = config.setup(device="cpu")
    orders = [datamanager.next_train(step)[1]["position"] for step in range(3)]
    assert all(sorted(order) == list(range(NUM_FRAMES - NUM_TEST)) for order in orders)
    assert len({tuple(order) for order in orders}) == 3


def test_a_step_is_the_same_whenever_it_is_asked_for(
    datamanager: RGBAvatarDataManager, tiny_data: Path
):
    config = RGBAvatarDataManagerConfig(data=tiny_data, batch_size=4, seed=5)
    other = config.setup(device="cpu")
    for step in (17, 3, 3):
        (there, other_batch), (here, batch) = other.next_train(step), datamanager.next_train(step)
        assert other_batch["position"] == batch["position"]
        assert torch.equal(other_batch["image"], batch["image"])
        assert torch.equal(there.metadata["background"], here.metadata["background"])


def test_batches_larger_than_the_dataset_are_the_dataset(tiny_data: Path):
    datamanager = RGBAvatarDataManagerConfig(data=tiny_data, batch_size=50).setup(device="cpu")
    _, batch = datamanager.next_train(0)
    assert sorted(batch["position"]) == list(range(NUM_FRAMES - NUM_TEST))


def test_evaluation_sees_every_held_out_frame_over_black(datamanager: RGBAvatarDataManager):
    loader = datamanager.fixed_indices_eval_dataloader
    for _ in range(2):
        seen = list(loader)
        assert len(seen) == NUM_TEST
    tracked = datamanager.dataparser.tracked
    for (camera, batch), position in zip(seen, tracked.test):
        rgba = torch.from_numpy(np.array(tracked.read_image(position))).double() / 255
        expected = rgba[..., :3] * rgba[..., 3:]
        torch.testing.assert_close(batch["image"].double(), expected, atol=1e-6, rtol=0)
        assert torch.equal(camera.metadata["theta"][0], tracked.theta[position])


@pytest.mark.parametrize("step", [0, 1, 500])
def test_single_evaluation_frame_belongs_to_its_camera(
    datamanager: RGBAvatarDataManager, step: int
):
    camera, batch = datamanager.next_eval_image(step)
    position = int(camera.metadata["position"][0])
    tracked = datamanager.dataparser.tracked
    assert position in tracked.test
    assert tracked.test[int(batch["image_idx"])] == position


def test_held_out_frames_among_the_others_keep_their_own_cameras(tmp_path: Path):
    tiny_dataset(tmp_path / "data")
    index = tmp_path / "data" / "dataset.json"
    content = json.loads(index.read_text())
    del content["test_frames"]
    content |= {"version": 2, "test": [content["frames"][k]["index"] for k in (0, 5, 6)]}
    index.write_text(json.dumps(content))
    config = RGBAvatarDataManagerConfig(data=tmp_path / "data", batch_size=11, seed=2)
    datamanager = config.setup(device="cpu")
    tracked = datamanager.dataparser.tracked
    assert tracked.test == (0, 5, 6)
    train, held_out = datamanager.next_train(0), datamanager.next_eval(0)
    for (cameras, batch), among in ((train, tracked.train), (held_out, tracked.test)):
        assert sorted(batch["position"]) == list(among)
        assert cameras.metadata is not None
        assert cameras.metadata["position"].flatten().tolist() == batch["position"]
        assert torch.equal(cameras.metadata["theta"], tracked.theta[batch["position"]])
        for image, position in zip(batch["image"], batch["position"]):
            assert np.array_equal(image.numpy(), tracked.read_image(position))
    camera, _ = datamanager.next_eval_image(1)
    assert int(camera.metadata["position"][0]) in tracked.test


def test_images_leave_half_of_a_gpus_free_memory(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (10 << 30, 12 << 30))
    assert device_budget(16 << 30, "cuda:0") == 5 << 30
    assert device_budget(1 << 30, torch.device("cuda")) == 1 << 30
    assert device_budget(16 << 30, "cpu") == 16 << 30


def test_images_on_a_device_have_room_for_views_behind_them_within_the_budget(
    tiny_data: Path, monkeypatch: pytest.MonkeyPatch
):
    config = RGBAvatarDataManagerConfig(data=tiny_data, batch_size=4)
    datamanager, rows = config.setup(device="cpu"), NUM_FRAMES - NUM_TEST + NUM_VIEWS
    needed = rows * SIZE * SIZE * 4
    place = "rgbavatar_ns.plugin.datamanager.device_budget"
    monkeypatch.setattr(place, lambda most, device: needed - 1)
    assert datamanager.device_frames() is None
    monkeypatch.setattr(place, lambda most, device: needed)
    frames = datamanager.device_frames()
    assert frames is not None
    assert frames.room is not None
    assert len(frames.room) == rows
    assert frames.images_rgba.data_ptr() == frames.room.data_ptr()
    tracked = load_dataset(tiny_data)
    for image, position in zip(frames.images_rgba, tracked.train, strict=True):
        assert np.array_equal(image.numpy(), tracked.read_image(position))
