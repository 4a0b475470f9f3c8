"""nerfstudio's trainer with the recorded step, on the emulated CUDA backend."""

from pathlib import Path
from typing import Any

import pytest
import torch

from rgbavatar_ns.avatar.training.recorded_step import RecordedStep
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer
from tests.kernels.cuda import emulator
from tests.plugin.run import parameters_of, small_config, trained

pytestmark = [
    pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to emulate CUDA with"),
    # torch warns where a schedule's step comes before its optimiser's.
    pytest.mark.filterwarnings("error:.*lr_scheduler.step"),
]


@pytest.fixture
def recorded(monkeypatch) -> list[int]:
    """The emulated backend, and a list that grows with each recorded step."""
    emulator.install(monkeypatch)
    steps: list[int] = []
    original = RecordedStep.__call__

    def counted(self, chosen, background):
        steps.append(len(chosen))
        return original(self, chosen, background)

    monkeypatch.setattr(RecordedStep, "__call__", counted)
    monkeypatch.setattr(RGBAvatarPipeline, "recorder", staticmethod(lambda work: work))
    return steps


def _train(data: Path, output: Path, *, steps: int = 5, **fields: Any) -> RGBAvatarTrainer:
    falling = {"learning_rate_factor": 0.5, "learning_rate_steps": 5}
    return trained(small_config(data, output, max_num_iterations=steps, **falling, **fields))


def test_runs_are_alike_with_and_without(recorded, tiny_data: Path, tmp_path: Path):
    with_it = _train(tiny_data, tmp_path / "with", steps=2)
    assert len(recorded) == 2
    without = _train(tiny_data, tmp_path / "without", steps=2, device_mib=0)
    assert len(recorded) == 2
    first, second = parameters_of(with_it), parameters_of(without)
    assert (first - second).norm() < 1e-2 * second.norm()
    seen = [t.pipeline.model.avatar.color_initialized for t in (with_it, without)]
    assert bool(seen[0].any())
    assert (seen[0] == seen[1]).float().mean() > 0.98


def test_a_run_in_two_pieces_is_the_run_in_one(recorded, tiny_data: Path, tmp_path: Path):
    whole = _train(tiny_data, tmp_path / "whole")
    first = _train(tiny_data, tmp_path / "parts", steps=3)
    second = _train(tiny_data, tmp_path / "parts", load_dir=first.checkpoint_dir)
    assert len(recorded) == 10
    assert torch.equal(parameters_of(whole), parameters_of(second))


def test_a_refined_run_goes_another_way(recorded, tiny_data: Path, tmp_path: Path):
    _train(tiny_data, tmp_path, steps=2, refine_tracking=True)
    assert recorded == []
