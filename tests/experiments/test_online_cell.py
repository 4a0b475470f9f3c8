"""A cell of an online preset: trained on a stream, scored on held-out and on streamed frames."""

import json

import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float
from rgbavatar_ns.experiments import read_experiment
from rgbavatar_ns.experiments.engines import LocalEngine
from rgbavatar_ns.experiments.report import write_report
from rgbavatar_ns.experiments.streamed import (
    StreamedCurve,
    read_streamed,
    streamed_losses,
    write_streamed,
)
from rgbavatar_ns.experiments.sweep import sweep
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.plugin.online.least_losses import read_least
from tests.plugin.online_run import online_config, online_trainer
from tests.plugin.run import SMALL, before_each_step, before_step, parameters_of
from tests.plugin.tiny import tiny_dataset

TEXT = """
title: Online
preset: rgbavatar-online-tiny
subjects: [data]
metrics: [psnr, ssim, l1_streamed, l1_forgotten, frames_per_second, peak_mib]
base:
  steps_after_stream: 40
  pipeline.datamanager.watch-every: 2
  pipeline.model.avatar.uv_resolution: 16
  pipeline.datamanager.source.frames_per_second: 100.0
variants:
  - name: half local
    set: {pipeline.datamanager.local-share: 0.5}
"""


@pytest.fixture
def dataset(tmp_path):
    return tiny_dataset(tmp_path / "data")


def test_each_streamed_frame_has_its_own_loss(dataset, tmp_path):
    avatar = Avatar(HeadModel(dataset.arrays), dataset.identity, SMALL)
    losses = streamed_losses(avatar, dataset)
    assert len(losses) == len(dataset.train) == 11  # one more than a batch and a half
    frame = dataset.train[9]
    with torch.no_grad():
        drawn = avatar.render(dataset.theta[frame][None], dataset.cameras.select([frame])).image
    rgba = torch.from_numpy(dataset.read_image(frame))[None]
    truth = composite(rgba_to_float(rgba), torch.zeros(3))
    assert losses[9] == pytest.approx(float((drawn - truth).abs().mean()), rel=1e-5)
    assert len({round(loss, 7) for loss in losses}) > 5
    numbers = [dataset.frame_index[frame] for frame in dataset.train]
    figures = write_streamed(avatar, dataset, tmp_path, {})
    curve = read_streamed(tmp_path)
    assert curve == StreamedCurve(dict(zip(numbers, losses)), {})
    assert figures == {"l1_streamed": pytest.approx(sum(losses) / 11)}
    (tmp_path / "streamed.json").write_text("{")
    assert read_streamed(tmp_path) is None


def test_forgotten_is_what_a_loss_is_above_its_least(dataset, tmp_path):
    avatar = Avatar(HeadModel(dataset.arrays), dataset.identity, SMALL)
    after = streamed_losses(avatar, dataset)
    numbers = [dataset.frame_index[frame] for frame in dataset.train]
    # One forgotten by .01, one that has never been as good as at the end, one of another stream.
    watched = {numbers[2]: after[2] - 0.01, numbers[5]: after[5] + 1, 10**6: 0.0}
    figures = write_streamed(avatar, dataset, tmp_path, watched)
    assert figures["l1_forgotten"] == pytest.approx(0.005)
    curve = read_streamed(tmp_path)
    assert curve is not None
    assert curve.least == {
        numbers[2]: pytest.approx(after[2] - 0.01),
        numbers[5]: pytest.approx(after[5]),
    }


def test_watched_frames_keep_their_least_loss_also_when_resumed(dataset, tmp_path):
    """The stream holds all frames; every third is watched, before and after the resume."""
    data = tmp_path / "data"
    config = online_config(tmp_path / "first", data, steps_after_stream=8, watch_every=3)
    trainer = online_trainer(config)
    before_each_step(trainer, lambda step: watch_at_once(trainer))
    before_step(4, trainer, trainer.shutdown)
    trainer.train()
    first = dict(trainer.stream.least.by_frame)
    assert first
    assert set(first) <= {0, 3, 6, 9}
    config = online_config(tmp_path / "rest", data, steps_after_stream=8, watch_every=3)
    config.load_dir = trainer.checkpoint_dir
    resumed = online_trainer(config)
    before_each_step(resumed, lambda step: watch_at_once(resumed))
    resumed.train()
    least = read_least(resumed.base_dir)
    assert set(least) == {0, 3, 6, 9}
    assert all(least[frame] <= loss for frame, loss in first.items())


def test_watching_changes_nothing_that_is_trained(dataset, tmp_path, monkeypatch):
    trainer = online_trainer(online_config(tmp_path / "out", tmp_path / "data", watch_every=2))

    watch = trainer._watch

    def look():
        before = parameters_of(trainer).clone()
        states = torch.get_rng_state(), trainer.stream.pools.state_dict()["pools"]
        watch_at_once(trainer)
        watch()
        after = torch.get_rng_state(), trainer.stream.pools.state_dict()["pools"]
        assert torch.equal(parameters_of(trainer), before)
        assert torch.equal(states[0], after[0])
        assert torch.equal(states[1]["generator"], after[1]["generator"])

    monkeypatch.setattr(trainer, "_watch", look)
    trainer.train()
    assert trainer.completed
    assert trainer.stream.least.by_frame


def watch_at_once(trainer):
    """Do not wait until watching takes less than its share of the time."""
    trainer._next_watch_s = 0.0


def test_without_watched_frames_nothing_is_kept(dataset, tmp_path):
    trainer = online_trainer(online_config(tmp_path / "out", tmp_path / "data"))
    trainer.train()
    assert not (trainer.base_dir / "least.json").exists()
    assert read_least(trainer.base_dir) == {}


def test_training_may_end_with_the_stream(dataset, tmp_path):
    """As in the paper, and in the experiments on streams."""
    config = online_config(tmp_path / "out", tmp_path / "data", steps_after_stream=0)
    trainer = online_trainer(config)
    trainer.train()
    assert trainer.stream.pools.num_added == len(dataset.train)
    assert trainer.stream.ended_step == trainer.step
    assert trainer.completed


@pytest.mark.nightly
def test_a_sweep_of_an_online_preset_ends_in_a_curve(dataset, tmp_path):
    path = tmp_path / "online.yaml"
    path.write_text(TEXT)
    experiment = read_experiment(path)
    (status,) = sweep(experiment, tmp_path / "out", LocalEngine())
    assert status.state == "done", "\n".join(status.why)
    assert status.result is not None
    run = tmp_path / "out/cells" / status.cell.key / "run/cell/rgbavatar-online-tiny/run"
    training = json.loads((run / "training.json").read_text())
    assert training["frames"] == len(dataset.train)
    curve = read_streamed(status.folder)
    assert curve is not None
    avatar_loss = streamed_losses(Avatar.load(run), dataset)
    assert list(curve.after.values()) == pytest.approx(avatar_loss, rel=1e-4)
    assert set(curve.least) == {0, 2, 4, 6, 8, 10}
    assert status.result["metrics"]["l1_forgotten"] == pytest.approx(curve.forgotten)
    assert status.result["metrics"]["frames_per_second"] > 0
    assert status.result["metrics"]["peak_mib"] > 100
    report = write_report(experiment, tmp_path / "out")
    assert "| half local | " in report.table.to_markdown()
    assert (tmp_path / "out/report/online_forgetting.png").stat().st_size > 1000
    assert "online_forgetting.png" in (tmp_path / "out/report/index.html").read_text()
