"""Steps without autograd through nerfstudio's trainer: when they are taken, and what they give."""

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.kernels import available_backends
from tests.plugin.run import make_trainer, newest_state, parameters_of, small_config, trained

pytestmark = pytest.mark.skipif("cpu" not in available_backends(), reason="not compiled")


@pytest.fixture
def fused_steps(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """One entry a fused step."""
    seen: list[bool] = []
    original = FusedStep.__call__

    def counted(self: FusedStep, *arguments: Any, **options: Any) -> Any:
        loss = original(self, *arguments, **options)
        seen.append(True)
        return loss

    monkeypatch.setattr(FusedStep, "__call__", counted)
    return seen


def _config(data: Path, output: Path, *, fast: bool = True, steps: int = 4):
    config = small_config(data, output, max_num_iterations=steps)
    config.pipeline.model.fast = fast
    return config


def test_training_is_fused_and_can_be_told_not_to_be(
    tiny_data: Path, tmp_path: Path, fused_steps: list[bool]
):
    trained(_config(tiny_data, tmp_path / "fast"))
    assert fused_steps == [True] * 4
    trained(_config(tiny_data, tmp_path / "eager", fast=False))
    assert len(fused_steps) == 4


def test_both_ways_begin_alike(tiny_data: Path, tmp_path: Path):
    """After one step, colour initialisation included; later steps part by rounding."""
    fast = trained(_config(tiny_data, tmp_path / "fast", steps=1))
    eager = trained(_config(tiny_data, tmp_path / "eager", fast=False, steps=1))
    first, second = parameters_of(fast), parameters_of(eager)
    # Adam's first step is the sign of the gradient: where that is zero up to rounding it may
    # differ by two learning rates, which is why the norm is compared.
    assert (first - second).norm() < 1e-2 * second.norm()
    seen = [t.pipeline.model.avatar.color_initialized for t in (fast, eager)]
    assert bool(seen[0].any())
    assert (seen[0] == seen[1]).float().mean() > 0.98


@pytest.mark.parametrize("reason", ["max_norm", "weight decay", "reference", "lpips"])
def test_what_cannot_be_fused_goes_through_autograd(
    reason: str,
    tiny_data: Path,
    tmp_path: Path,
    fused_steps: list[bool],
    monkeypatch: pytest.MonkeyPatch,
):
    config = _config(tiny_data, tmp_path, steps=3)
    if reason == "max_norm":
        config.optimizers["color"]["optimizer"].max_norm = 1.0
    elif reason == "reference":
        config.pipeline.model.rasterizer = "reference"
    elif reason == "lpips":
        config.pipeline.model.lpips_weight = 0.05
        config.pipeline.model.lpips_start_step = 2
    trainer = make_trainer(config)
    if reason == "weight decay":
        trainer.optimizers.optimizers["color"].param_groups[0]["weight_decay"] = 0.01
    monkeypatch.setattr(
        trainer.pipeline.model, "lpips_loss", lambda image, target: (image - target).square().mean()
    )
    before = parameters_of(trainer)
    trainer.train()
    assert len(fused_steps) == (2 if reason == "lpips" else 0)
    assert not torch.equal(parameters_of(trainer), before)


def test_a_run_changes_its_way_on_resume(tiny_data: Path, tmp_path: Path):
    """Fused, eager, fused: every optimiser's count and the schedules go on."""
    folder: Path | None = None
    for steps, fast in ((2, True), (4, False), (6, True)):
        config = _config(tiny_data, tmp_path, fast=fast, steps=steps)
        config.load_dir, config.learning_rate_factor = folder, 0.1
        config.learning_rate_steps = 6
        with warnings.catch_warnings():
            # torch warns where a schedule's step comes before its optimiser's.
            warnings.filterwarnings("error", message=".*lr_scheduler.step.*")
            trainer = trained(config)
        folder = trainer.checkpoint_dir
    state = newest_state(trainer.checkpoint_dir)
    for name, saved in state["optimizers"].items():
        assert {float(each["step"]) for each in saved["state"].values()} == {6.0}, name
        assert saved["param_groups"][0]["lr"] == pytest.approx(
            0.1 * config.optimizers[name]["optimizer"].lr
        )
