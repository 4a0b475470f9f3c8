"""Steps without autograd through nerfstudio's trainer: when they are taken, and what they give."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.kernels import available_backends
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig
from tests.plugin.run import make_trainer, newest_state, parameters_of

pytestmark = pytest.mark.skipif("cpu" not in available_backends(), reason="not compiled")
Train = Callable[..., RGBAvatarTrainer]


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


def test_training_is_fused_and_can_be_told_not_to_be(train: Train, fused_steps: list[bool]):
    train("fast", max_num_iterations=4)
    assert fused_steps == [True] * 4
    train("eager", max_num_iterations=4, fast=False)
    assert len(fused_steps) == 4


@pytest.mark.parametrize("reason", ["max_norm", "weight decay", "reference", "lpips"])
def test_what_cannot_be_fused_goes_through_autograd(
    reason: str,
    config_of: Callable[..., RGBAvatarTrainerConfig],
    fused_steps: list[bool],
    monkeypatch: pytest.MonkeyPatch,
):
    config = config_of(max_num_iterations=3)
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
    monkeypatch.setattr(LPIPSLoss, "__call__", lambda _, image, target: (image - target).norm())
    before = parameters_of(trainer)
    trainer.train()
    assert len(fused_steps) == (2 if reason == "lpips" else 0)
    assert not torch.equal(parameters_of(trainer), before)


# torch warns where a schedule's step comes before its optimiser's.
@pytest.mark.filterwarnings("error:.*lr_scheduler.step")
def test_a_run_changes_its_way_on_resume(train: Train):
    """Fused, eager, fused: every optimiser's count and the schedules go on."""
    folder: Path | None = None
    falling = {"learning_rate_factor": 0.1, "learning_rate_steps": 6}
    for steps, fast in ((2, True), (4, False), (6, True)):
        trainer = train(max_num_iterations=steps, fast=fast, load_dir=folder, **falling)
        folder = trainer.checkpoint_dir
    state = newest_state(trainer.checkpoint_dir)
    for name, saved in state["optimizers"].items():
        assert {float(each["step"]) for each in saved["state"].values()} == {6.0}, name
        assert saved["param_groups"][0]["lr"] == pytest.approx(
            0.1 * trainer.config.optimizers[name]["optimizer"].lr
        )
