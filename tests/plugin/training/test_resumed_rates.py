"""A run that goes on has the learning rates that are asked for now, as far fallen as they are."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer
from tests.plugin.run import before_each_step, make_trainer, small_config

_FALLS: dict[str, Any] = {
    "learning_rate_factor": 0.01,
    "learning_rate_steps": 10,
    "learning_rate_decay": "exponential",
}
_FALLS_LINEARLY = {**_FALLS, "learning_rate_decay": "linear"}
_STAYS: dict[str, Any] = {"learning_rate_factor": 1.0, "position_lr_final": None}


def run(data: Path, output: Path, rate: float | None = None, **fields: Any) -> list[float]:
    """The rate of colours in each step, of a run that ends after `max_num_iterations`."""
    return _run(data, output, rate, **fields)[1]


def _run(
    data: Path, output: Path, rate: float | None, **fields: Any
) -> tuple[RGBAvatarTrainer, list[float]]:
    config = small_config(data, output, **fields)
    config.optimizers = copy.deepcopy(config.optimizers)
    if rate is not None:
        config.optimizers["color"]["optimizer"].lr = rate
    trainer, seen = make_trainer(config), []
    color = trainer.optimizers.optimizers["color"]
    before_each_step(trainer, lambda step: seen.append(color.param_groups[0]["lr"]))
    trainer.train()
    return trainer, seen


@pytest.fixture
def begun(tiny_data: Path, tmp_path: Path) -> Callable[..., tuple[Path, list[float]]]:
    def begin(**fields: Any) -> tuple[Path, list[float]]:
        trainer, seen = _run(tiny_data, tmp_path / "first", 0.02, max_num_iterations=4, **fields)
        return trainer.checkpoint_dir, seen

    return begin


@pytest.mark.parametrize("falls", [_STAYS, _FALLS, _FALLS_LINEARLY])
def test_another_rate_is_taken_as_far_as_it_has_fallen(
    falls: dict[str, Any], begun: Callable[..., Any], tiny_data: Path, tmp_path: Path
):
    folder, _ = begun(**falls)
    whole = run(tiny_data, tmp_path / "whole", 0.005, max_num_iterations=7, **falls)
    second = run(tiny_data, tmp_path / "s", 0.005, max_num_iterations=7, load_dir=folder, **falls)
    assert second == pytest.approx(whole[4:], rel=1e-6)
    assert len(second) == 3


def test_rates_fall_by_the_same_amount_each_step_where_that_is_asked(
    tiny_data: Path, tmp_path: Path
):
    fields = {**_FALLS_LINEARLY, "learning_rate_steps": 4, "max_num_iterations": 6}
    seen = run(tiny_data, tmp_path, 0.02, **fields)
    # .02 less a quarter of .0198 each step, and a hundredth from the fourth on.
    assert seen == pytest.approx([0.02, 0.01505, 0.0101, 0.00515, 0.0002, 0.0002], rel=1e-6)


def test_a_schedule_that_is_new_stands_where_it_would(
    begun: Callable[..., Any], tiny_data: Path, tmp_path: Path
):
    folder, _ = begun(**_STAYS)
    fields = {"max_num_iterations": 7, "load_dir": folder}
    seen = run(tiny_data, tmp_path / "s", 0.02, **fields, **_FALLS, position_lr_final=None)
    assert seen == pytest.approx([0.02 * 0.01 ** (step / 10) for step in (4, 5, 6)], rel=1e-6)


def test_without_the_schedule_the_rate_is_whole_again(
    begun: Callable[..., Any], tiny_data: Path, tmp_path: Path
):
    folder, before = begun(**_FALLS)
    assert before[3] < 0.01
    seen = run(tiny_data, tmp_path / "s", 0.02, max_num_iterations=6, load_dir=folder, **_STAYS)
    assert seen == pytest.approx([0.02, 0.02], rel=1e-6)
