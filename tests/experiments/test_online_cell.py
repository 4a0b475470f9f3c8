"""A cell of an online preset: trained on a stream, scored on held-out and on streamed frames."""

import json

import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float
from rgbavatar_ns.experiments import read_experiment
from rgbavatar_ns.experiments.engines import LocalEngine
from rgbavatar_ns.experiments.report import write_report
from rgbavatar_ns.experiments.streamed import read_streamed, streamed_losses, write_streamed
from rgbavatar_ns.experiments.sweep import sweep
from rgbavatar_ns.head import HeadModel
from tests.plugin.online_run import online_config, online_trainer
from tests.plugin.run import SMALL
from tests.plugin.tiny import tiny_dataset

TEXT = """
title: Online
preset: rgbavatar-online-tiny
subjects: [data]
metrics: [psnr, ssim, l1_streamed]
base:
  steps_after_stream: 2
  pipeline.model.avatar.uv_resolution: 16
  pipeline.datamanager.source.frames_per_second: 100.0
variants:
  - name: w/o global
    set: {pipeline.datamanager.global_size: 0, pipeline.datamanager.local_size: 3}
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
    mean = write_streamed(avatar, dataset, tmp_path)
    curve = read_streamed(tmp_path)
    assert curve == ([dataset.frame_index[frame] for frame in dataset.train], losses)
    assert mean == pytest.approx(sum(losses) / 11)
    (tmp_path / "streamed.json").write_text("{")
    assert read_streamed(tmp_path) is None


def test_training_may_end_with_the_stream(dataset, tmp_path):
    """As in the paper, and in the experiments on streams."""
    config = online_config(tmp_path / "out", tmp_path / "data", steps_after_stream=0)
    trainer = online_trainer(config)
    trainer.train()
    assert trainer.stream.pools.num_added == len(dataset.train)
    assert trainer.stream.ended_step == trainer.step
    assert trainer.completed


@pytest.mark.slow
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
    assert curve[1] == pytest.approx(avatar_loss, rel=1e-4)
    report = write_report(experiment, tmp_path / "out")
    assert "| w/o global | " in report.table.to_markdown()
    assert (tmp_path / "out/report/online_forgetting.png").stat().st_size > 1000
    assert "online_forgetting.png" in (tmp_path / "out/report/index.html").read_text()
