"""However a run on a stream ends, the avatar is saved before anything that takes long."""

from collections.abc import Callable
from pathlib import Path

import pytest

from rgbavatar_ns.avatar.storage.checkpoint_file import list_checkpoints
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import DiskError
from rgbavatar_ns.plugin.online.trainer import OnlineTrainer
from tests.plugin.online_run import online_config, online_trainer
from tests.plugin.run import before_step

FULL = DiskError("There is no space left to write stream.", "Free some space.")
Online = Callable[..., OnlineTrainer]


@pytest.fixture
def online(tiny_data: Path, tmp_path: Path) -> Online:
    """A trainer that replays the tiny dataset into the one folder of the test."""
    return lambda **fields: online_trainer(online_config(tmp_path, tiny_data, **fields))


def fails(error: BaseException) -> Callable[[], None]:
    def failing() -> None:
        raise error

    return failing


def saved_steps(trainer: OnlineTrainer) -> list[int]:
    return [step for step, _ in list_checkpoints(trainer.checkpoint_dir)]


def test_what_interrupts_looking_back_costs_no_step(online: Online):
    trainer = online()
    before_step(2, trainer, trainer.stop.request)
    trainer.pipeline.training_frames = fails(KeyboardInterrupt())  # type: ignore
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    assert saved_steps(trainer) == [trainer.step]


@pytest.mark.parametrize("error", [FULL, KeyboardInterrupt()], ids=["full disk", "Ctrl-C"])
def test_pools_that_cannot_be_recorded_cost_no_step(online: Online, error: BaseException):
    trainer = online()
    before_step(2, trainer, trainer.stop.request)
    trainer.stream.record = fails(error)
    with pytest.raises(type(error)):
        trainer.train()
    assert saved_steps(trainer) == [2]
    resumed = online(load_dir=trainer.checkpoint_dir)
    assert resumed.stream.pools.num_added > 0
    resumed.train()
    assert resumed.completed
    assert resumed.step > 2


def test_a_fault_of_the_source_saves_before_the_pools_are_recorded(online: Online):
    trainer = online()
    fault = UserError("The camera is gone.", "Find it.")
    before_step(1, trainer, lambda: setattr(trainer.stream.ingest, "failure", fault))
    trainer.stream.record = fails(FULL)
    with pytest.raises(DiskError):
        trainer.train()
    assert saved_steps(trainer) == [1]
