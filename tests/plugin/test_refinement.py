"""Refined tracking through nerfstudio's trainer: what is corrected, resumed, written, scored."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.refinement.corrections import RefinementConfig
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import DiskError
from rgbavatar_ns.kernels import available_backends
from rgbavatar_ns.plugin.refinement import frame_refinement
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig
from tests.plugin.run import (
    before_each_step,
    before_step,
    make_trainer,
    small_config,
    trained,
)
from tests.plugin.tiny import NUM_FRAMES, NUM_TEST

START = 2
TRAINED = NUM_FRAMES - NUM_TEST


def _config(
    data: Path, output: Path, steps: int = 8, *, refine=True, bases_start=0.0, **fields: Any
) -> RGBAvatarTrainerConfig:
    refined = {
        "refine_tracking": refine,
        "refinement": RefinementConfig(start_step=START, bases_start=bases_start),
    }
    steps_to = {"max_num_iterations": steps, "learning_rate_steps": 8}
    return small_config(data, output, **steps_to | refined | fields)


def _interrupted(config: RGBAvatarTrainerConfig, taken: int) -> RGBAvatarTrainer:
    """Train until Ctrl-C in the last of so many steps."""
    trainer = make_trainer(config)
    before_step(taken - 1, trainer, trainer.stop.request)
    trainer.train()
    return trainer


def _corrections(trainer: RGBAvatarTrainer) -> torch.Tensor:
    refinement = trainer.pipeline.model.refinement
    assert refinement is not None
    return refinement.frames.correction


@pytest.mark.parametrize("fast", [True, False], ids=["fused", "eager"])
def test_training_frames_are_corrected_and_held_out_ones_calibrated(tiny_data, tmp_path, fast):
    trainer = trained(_config(tiny_data, tmp_path, fast=fast))
    model = trainer.pipeline.model
    refined = np.load(trainer.base_dir / "theta_refined.npy", allow_pickle=False)
    tracked = model.frame_theta.numpy()
    assert refined.shape == tracked.shape
    moved = refined != tracked
    assert moved[:TRAINED].any(1).all()
    model.eval()
    drawn = model.driving_theta(list(range(TRAINED, NUM_FRAMES)))
    assert model.refinement is not None
    assert model.refinement.frames.calibrated(model.frame_theta[TRAINED:]).equal(drawn)
    np.testing.assert_array_equal(refined[TRAINED:], drawn.numpy())
    # Of this subject only the head's turn about y and the jaw's opening move.
    layout = model.avatar.layout
    assert set(np.flatnonzero(moved.any(0))) == {
        layout.slice("rotation").start + 1,
        layout.slice("jaw").start,
    }


def test_corrections_that_the_disk_refuses_are_told_and_leave_the_earlier_ones(
    tiny_data, tmp_path, monkeypatch
):
    """What a full disk cuts off is no file of corrections."""
    trainer = trained(_config(tiny_data, tmp_path))
    path = trainer.base_dir / "theta_refined.npy"
    whole = path.read_bytes()

    def full(place, array):
        Path(place).write_bytes(whole[:40])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(DiskError, match=r"no space left to write .*theta_refined\.npy"):
        trained(_config(tiny_data, tmp_path, load_dir=trainer.checkpoint_dir))
    assert path.read_bytes() == whole
    assert not list(trainer.base_dir.glob(".theta_refined*"))
    assert json.loads((trainer.base_dir / "training.json").read_text())["steps"] == 8


def test_both_ways_correct_alike(tiny_data, tmp_path):
    """The first correction follows the same gradient, whichever way it was found."""
    if "cpu" not in available_backends():
        pytest.skip("not compiled")
    fused, eager = (
        trained(_config(tiny_data, tmp_path / str(fast), START + 1, fast=fast))
        for fast in (True, False)
    )
    first, second = _corrections(fused), _corrections(eager)
    assert float(second.norm()) > 0
    assert float((first - second).norm()) < 0.05 * float(second.norm())


def test_nothing_is_corrected_before_the_start(tiny_data, tmp_path):
    plain = trained(_config(tiny_data, tmp_path / "plain", START, refine=False))
    refined = trained(_config(tiny_data, tmp_path / "refined", START))
    assert not bool(_corrections(refined).any())
    for first, second in zip(
        plain.pipeline.model.avatar.parameters(), refined.pipeline.model.avatar.parameters()
    ):
        torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("fast", [True, False], ids=["fused", "eager"])
def test_bases_wait_for_corrections_and_then_learn(tiny_data, tmp_path, fast):
    bases = {}
    for steps in (4, 5):
        config = _config(tiny_data, tmp_path / str(steps), fast=fast, bases_start=0.5)
        shapes = _interrupted(config, steps).pipeline.model.avatar.blendshapes
        bases[steps] = [shapes.basis_position, shapes.basis_color_feature]
    assert not any(bool(basis.any()) for basis in bases[4])
    assert all(bool(basis.any()) for basis in bases[5])


def _rates_of_bases(config: RGBAvatarTrainerConfig) -> list[float]:
    """In each step of a run."""
    trainer, rates = make_trainer(config), []
    (group,) = trainer.optimizers.optimizers["basis_position"].param_groups
    before_each_step(trainer, lambda step: rates.append(group["lr"]))
    trainer.train()
    return rates


def test_bases_learn_in_a_run_that_is_shorter_than_its_schedule(tiny_data, tmp_path):
    short = _config(tiny_data, tmp_path, 4, bases_start=0.5, learning_rate_steps=100)
    assert [rate > 0 for rate in _rates_of_bases(short)] == [False, False, True, True]


def test_bases_of_a_complete_run_that_goes_on_do_not_wait_again(tiny_data, tmp_path):
    """Nor when it goes on once more."""
    folder = trained(_config(tiny_data, tmp_path / "4", 4, bases_start=0.5)).checkpoint_dir
    for steps, before in ((14, 4), (40, 14)):
        fields: dict[str, Any] = {"learning_rate_steps": None, "load_dir": folder}
        longer = _config(tiny_data, tmp_path / str(steps), steps, bases_start=0.5, **fields)
        rates = _rates_of_bases(longer)
        assert len(rates) == steps - before
        assert all(rate > 0 for rate in rates)
        longer.load_dir = None
        folder = longer.get_checkpoint_dir()


def test_bases_that_have_waited_wait_for_as_long_as_a_longer_run_asks(tiny_data, tmp_path):
    first = _interrupted(_config(tiny_data, tmp_path / "first", bases_start=0.5), 2)
    longer = _config(
        *(tiny_data, tmp_path / "second", 12),
        bases_start=0.5,
        learning_rate_steps=None,
        load_dir=first.checkpoint_dir,
    )
    assert [rate > 0 for rate in _rates_of_bases(longer)] == [False] * 4 + [True] * 6


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_bases_that_would_never_learn_are_refused(tiny_data, tmp_path, share):
    with pytest.raises(UserError, match="bases-start"):
        make_trainer(_config(tiny_data, tmp_path, bases_start=share))


def test_a_run_of_so_many_seconds_says_over_how_many_steps_its_bases_wait(
    tiny_data, tmp_path, capsys
):
    def begun(name: str, **fields: Any) -> RGBAvatarTrainer:
        seconds = {"max_train_seconds": 6.0, "max_num_iterations": 5000}
        config = _config(tiny_data, tmp_path / name, bases_start=0.5, **seconds | fields)
        trainer = make_trainer(config)
        after_step = trainer.after_step
        trainer.after_step = lambda step, losses, seconds: after_step(step, losses, 2.0)
        return trainer

    with pytest.raises(UserError, match=r"--max-train-seconds is 6\.0, but") as refused:
        begun("unknown", learning_rate_steps=None)
    assert "--learning-rate-steps" in refused.value.remedy
    for steps, learned in ((4, True), (8, False)):
        trainer = begun(str(steps), learning_rate_steps=steps)
        capsys.readouterr()
        trainer.train()
        assert trainer.step == 2
        assert bool(trainer.pipeline.model.avatar.blendshapes.basis_position.any()) == learned
        told = " ".join(capsys.readouterr().out.split())
        assert ("bases have learned nothing, since they begin with step 4" in told) != learned


@pytest.mark.parametrize("first_end", [3, 5], ids=["bases wait", "bases learn"])
def test_resume_equals_uninterrupted_run(tiny_data, tmp_path, first_end):
    def config(name: str, load_dir: Path | None = None) -> RGBAvatarTrainerConfig:
        return _config(tiny_data, tmp_path / name, bases_start=0.5, load_dir=load_dir)

    whole = trained(config("whole"))
    half = _interrupted(config("half"), first_end)
    rest = trained(config("rest", half.checkpoint_dir))
    first, second = (t.pipeline.model.state_dict() for t in (whole, rest))
    tensors = [name for name, value in first.items() if isinstance(value, torch.Tensor)]
    assert any("correction" in name for name in tensors)
    assert all(torch.equal(first[name], second[name]) for name in tensors)


@pytest.mark.parametrize("saved", [True, False])
def test_a_checkpoint_of_the_other_kind_is_refused(tiny_data, tmp_path, saved):
    first = trained(_config(tiny_data, tmp_path / "first", 3, refine=saved))
    folder = first.checkpoint_dir
    config = _config(tiny_data, tmp_path / "second", 4, refine=not saved, load_dir=folder)
    with pytest.raises(UserError, match=f"refine-tracking {saved}"):
        make_trainer(config)


def test_a_stream_is_refused(tiny_data, tmp_path):
    """Its model knows one frame of many."""
    trainer = make_trainer(_config(tiny_data, tmp_path, refine=False))
    model = trainer.pipeline.model
    streamed = dataclasses.replace(
        model.subject,
        theta=model.subject.theta[:1],
        world_to_camera=model.subject.world_to_camera[:1],
    )
    with pytest.raises(UserError, match="while frames arrive"):
        frame_refinement(streamed, model.config.refinement)


def test_held_out_frames_are_fitted_apart_from_the_plain_score(tiny_data, tmp_path):
    """The plain score stays to the digit; fitting from a wrong theta raises the other one."""
    avatar = AvatarConfig(uv_resolution=32, num_bases=0, scale_from_texel_spacing=True)
    pipeline = trained(
        small_config(tiny_data, tmp_path, avatar=avatar, max_num_iterations=60)
    ).pipeline
    pipeline.test_mode = "test"
    plain = pipeline.get_average_eval_image_metrics()
    assert not any(name.endswith("_refined") or name.startswith("detail") for name in plain)
    model = pipeline.model
    model.frame_theta[TRAINED:, model.avatar.layout.slice("rotation").start + 1] += 0.05
    scores = {}
    for steps in (1, 40):
        pipeline.config.model.refine_held_out = steps
        scores[steps] = pipeline.get_average_eval_image_metrics()
        assert scores[steps]["psnr"] == plain["psnr"]
        assert {"psnr_refined", "psnr_head_refined", "ssim_refined"} <= scores[steps].keys()
    assert scores[40]["psnr_refined"] > scores[1]["psnr_refined"] + 0.3


def test_so_many_held_out_frames_are_fitted_as_are_asked_for(pipeline, monkeypatch):
    """The first, the last and what lies evenly between; or all."""
    count, fitted = len(pipeline.datamanager.dataparser.tracked.test), []
    assert count > 2

    def keep(avatar, theta, *_, **__):
        fitted.extend(theta)
        return theta

    monkeypatch.setattr("rgbavatar_ns.plugin.pipeline.fit_theta", keep)
    held_out = pipeline.model.driving_theta(list(pipeline.datamanager.dataparser.tracked.test))
    for asked, expected in ((2, 2), (0, count), (99, count)):
        fitted.clear()
        monkeypatch.setattr(pipeline.config.model, "refine_held_out_frames", asked)
        pipeline._refined_metrics()
        assert len(fitted) == expected
        assert torch.equal(fitted[0], held_out[0])
        assert torch.equal(fitted[-1], held_out[-1])
