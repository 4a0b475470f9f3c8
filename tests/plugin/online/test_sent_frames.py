"""A run of ns-train on frames that another program sends."""

import dataclasses
import json
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.utils.eval_utils import eval_setup

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.data import TrackedFrame, load_dataset
from rgbavatar_ns.data.streams import StreamClient, StreamSubject
from rgbavatar_ns.export import dataset_folder
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from rgbavatar_ns.plugin.online.methods import rgbavatar_online_tiny
from rgbavatar_ns.plugin.online.sources import SourceConfig
from rgbavatar_ns.plugin.online.trainer import OnlineTrainer
from tests.plugin.online_run import online_config, online_trainer
from tests.plugin.run import before_each_step, newest_state
from tests.plugin.tiny import NUM_FRAMES, NUM_TEST

STREAMED = NUM_FRAMES - NUM_TEST


def summary(trainer: OnlineTrainer) -> dict[str, Any]:
    return json.loads((trainer.base_dir / "training.json").read_text())


def rate(trainer: OnlineTrainer) -> float:
    return trainer.optimizers.optimizers["color"].param_groups[0]["lr"]


def subject_and_frames(data: Path) -> tuple[StreamSubject, list[TrackedFrame]]:
    dataset = load_dataset(data)
    subject = StreamSubject(
        dataset.arrays, dataset.identity, dataset.layout, dataset.width, dataset.height
    )
    frames = [
        TrackedFrame(
            i, dataset.theta[i], dataset.cameras.select([i]), np.array(dataset.read_image(i))
        )
        for i in dataset.train
    ]
    return subject, frames


def test_frames_sent_over_a_socket_are_trained_on_and_kept(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    subject, frames = subject_and_frames(tiny_data)
    frames[4].image_rgba[:2] = UNFILMED_RGBA
    subject = dataclasses.replace(subject, session="mine")
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"

    watch: list[Callable[[OnlineTrainer], None]] = []

    def send() -> None:
        client = StreamClient(subject, address)
        for frame in frames[:5]:
            client.send(frame)
        client.close()  # lost; the training goes on, and another client too
        with StreamClient(subject, address) as again:
            for frame in frames[5:]:
                again.send(frame)

    def train(output: Path, **fields: Any) -> OnlineTrainer:
        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        source = SourceConfig("socket", listen=address)
        trainer = online_trainer(online_config(output, source=source, **fields))
        before_each_step(trainer, lambda step: [look(trainer) for look in watch])
        trainer.train()
        thread.join()
        return trainer

    trainer = train(tmp_path / "out")
    told = summary(trainer)["stream"]
    assert told["taken in"] == STREAMED
    assert told["source lost"] == told["reconnects"] == 1
    # The checkpoint is an avatar with the performance that the pools held.
    loaded = Avatar.load(trainer.base_dir)
    frames_saved = newest_state(trainer.checkpoint_dir)["pipeline"]["_model._extra_state"]["frames"]
    assert torch.equal(frames_saved["theta"], load_dataset(tiny_data).theta[:STREAMED])
    assert loaded.num_gaussians == trainer.pipeline.model.avatar.num_gaussians
    seen = load_avatar(trainer.base_dir).training_statistics
    assert seen is not None
    assert seen.num_frames == STREAMED
    # The run is complete in itself: it holds the frames, and other commands find them.
    assert dataset_folder(trainer.base_dir) == trainer.base_dir / "stream"
    recorded = load_dataset(dataset_folder(trainer.base_dir))
    assert len(recorded) == STREAMED
    assert torch.equal(recorded.theta, load_dataset(tiny_data).theta[:STREAMED])
    assert np.array_equal(recorded.read_image(4), frames[4].image_rgba)  # marks and all
    monkeypatch.setitem(all_methods, "rgbavatar-online-tiny", rgbavatar_online_tiny.config)
    _, pipeline, _, step = eval_setup(trainer.base_dir / "config.yml")
    assert step == trainer.step
    assert len(pipeline.datamanager.train_dataset) == STREAMED
    # A resumed run knows what has been there.
    # After its stream's end it goes on with a new one, at the rates that were asked for.
    rates: list[float] = []
    watch.append(lambda trainer: rates.append(rate(trainer)))
    asked = rate(online_trainer(online_config(tmp_path / "asked", tiny_data)))
    assert rate(trainer) == pytest.approx(asked / 10)
    more = train(tmp_path / "more", load_dir=trainer.checkpoint_dir)
    assert more.step > trainer.step
    assert rates[0] == pytest.approx(asked)
    assert summary(more)["stream"]["taken in"] == STREAMED
    assert summary(more)["stream"]["duplicate"] == STREAMED
