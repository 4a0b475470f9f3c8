"""A run that is given seconds: it ends complete when they are used up, over all its sessions."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.training.load_config import COMPLETED
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig
from tests.plugin.online_run import online_config, online_trainer
from tests.plugin.run import make_trainer, newest_state

ConfigOf = Callable[..., RGBAvatarTrainerConfig]
TAKES = 2.0
"""Seconds that a step of these tests takes."""


def _train(config: RGBAvatarTrainerConfig, *, stop_before: int | None = None) -> RGBAvatarTrainer:
    """Train with steps of two seconds each, as the run counts them."""
    trainer = make_trainer(config)
    after_step = trainer.after_step
    trainer.after_step = lambda step, losses, seconds: after_step(step, losses, TAKES)
    if stop_before is not None:
        goes_on = trainer.goes_on
        trainer.goes_on = lambda step: step < stop_before and goes_on(step)
    trainer.train()
    return trainer


def _summary(trainer: RGBAvatarTrainer) -> dict[str, Any]:
    return json.loads((trainer.base_dir / "training.json").read_text())


def test_it_ends_complete_with_the_step_that_uses_them_up(
    config_of: ConfigOf, capsys: pytest.CaptureFixture[str]
):
    summary = _summary(_train(config_of(max_train_seconds=7.0)))
    assert (summary["ended"], summary["steps"], summary["images"]) == (COMPLETED, 4, 16)
    assert summary["train_seconds"] == 4 * TAKES
    told = " ".join(capsys.readouterr().out.split())
    assert ", 2 of 7 s" in told
    assert "Trained 4 steps in the 8 s that it was given" in told


def test_steps_that_are_done_sooner_end_it_as_ever(
    config_of: ConfigOf, capsys: pytest.CaptureFixture[str]
):
    summary = _summary(_train(config_of(max_train_seconds=100.0, max_num_iterations=3)))
    assert (summary["ended"], summary["steps"]) == (COMPLETED, 3)
    assert "it was given" not in capsys.readouterr().out


def test_seconds_count_over_all_sessions_and_equal_the_run_in_one(
    config_of: ConfigOf, capsys: pytest.CaptureFixture[str]
):
    whole = _train(config_of("whole", max_train_seconds=10.0))
    first = _train(config_of("rest", max_train_seconds=10.0), stop_before=2)
    assert _summary(first)["ended"] == "stopped"
    resume = {"max_train_seconds": 10.0, "load_dir": first.checkpoint_dir}
    second = _train(config_of("rest", **resume))
    assert _summary(second)["steps"] == _summary(whole)["steps"] == 5
    ends = [newest_state(run.checkpoint_dir)["pipeline"] for run in (whole, second)]
    assert all(a.equal(ends[1][name]) for name, a in ends[0].items() if hasattr(a, "equal"))
    # All used up: nothing more is trained. More seconds: it goes on.
    capsys.readouterr()
    again = _train(config_of("rest", **resume))
    assert "--max-train-seconds 10 asks for no more" in " ".join(capsys.readouterr().out.split())
    assert (_summary(again)["ended"], _summary(again)["steps"]) == (COMPLETED, 5)
    longer = _train(config_of("rest", **{**resume, "max_train_seconds": 14.0}))
    assert (_summary(longer)["ended"], _summary(longer)["steps"]) == (COMPLETED, 7)


def test_a_stream_may_be_left_before_its_end(tiny_data: Path, tmp_path: Path):
    config = online_config(tmp_path, tiny_data, max_train_seconds=6.0, steps_after_stream=100)
    trainer = online_trainer(config)
    after_step = trainer.after_step
    trainer.after_step = lambda step, losses, seconds: after_step(step, losses, TAKES)
    trainer.train()
    assert (_summary(trainer)["ended"], _summary(trainer)["steps"]) == (COMPLETED, 3)


@pytest.mark.parametrize("wrong", [0.0, -5.0, math.nan, math.inf])
def test_nonsense_is_refused_before_the_first_file(config_of: ConfigOf, wrong: float):
    config = config_of(max_train_seconds=wrong)
    with pytest.raises(UserError, match="--max-train-seconds is"):
        make_trainer(config)
    assert not config.get_base_dir().exists()
