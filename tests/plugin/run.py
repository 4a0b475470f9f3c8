"""Training runs: in this process through nerfstudio's trainer, or through its commands."""

import copy
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.scripts.train import _set_random_seed
from nerfstudio.utils import writer

from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.storage.checkpoint_file import list_checkpoints, read_checkpoint
from rgbavatar_ns.plugin.methods import rgbavatar_tiny
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig
from tests.plugin.forked import run_forked

SMALL = AvatarConfig(uv_resolution=16, num_bases=3, hidden_width=16, scale_from_texel_spacing=True)
# Entry points exist only once the package is installed; the variable works without.
_METHODS = (
    "rgbavatar=rgbavatar_ns.plugin.methods:rgbavatar,"
    "rgbavatar-tiny=rgbavatar_ns.plugin.methods:rgbavatar_tiny"
)


def small_config(data: Path, output: Path, **fields: Any) -> RGBAvatarTrainerConfig:
    """rgbavatar-tiny with fewer Gaussians and steps, set up with `fields`."""
    config = copy.deepcopy(rgbavatar_tiny.config)
    assert isinstance(config, RGBAvatarTrainerConfig)
    config.pipeline.datamanager.data = data
    small = {"max_num_iterations": 20, "batch_size": 4, "avatar": SMALL, "lpips_metric": False}
    set_up(config, output, **small | fields)
    return config


def set_up(config: RGBAvatarTrainerConfig, output: Path, **fields: Any) -> None:
    """Train on the CPU, without a viewer, in output/tiny/METHOD/run.

    `fields` are the trainer's, or where it has none the data manager's or the model's.
    """
    config.machine.device_type = "cpu"
    where = {"output_dir": output, "experiment_name": "tiny", "timestamp": "run"}
    parts = (config, config.pipeline.datamanager, config.pipeline.model)
    for name, value in (where | {"vis": "tensorboard"} | fields).items():
        owner = next(part for part in parts if hasattr(part, name))
        setattr(owner, name, value)


def make_trainer(config: RGBAvatarTrainerConfig) -> RGBAvatarTrainer:
    """What `ns-train` does up to the first step."""
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    _set_random_seed(config.machine.seed)
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def before_each_step(trainer: RGBAvatarTrainer, work: Callable[[int], None]) -> None:
    """Call `work` with the step's number."""
    where = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
    trainer.callbacks.append(TrainingCallback(where, lambda step: work(step)))


def before_step(number: int, trainer: RGBAvatarTrainer, work: Callable[[], object]) -> None:
    """Call `work` before one step."""
    before_each_step(trainer, lambda step: work() if step == number else None)


def assert_learns(trainer: RGBAvatarTrainer) -> None:
    """Training halves the loss of held-out frames and gives Gaussians their colours."""
    pipeline = trainer.pipeline

    def loss() -> float:
        with torch.no_grad():
            return float(pipeline.get_eval_loss_dict(0)[1]["l1"])

    before = loss()
    trainer.train()
    assert loss() < 0.5 * before
    assert bool(pipeline.model.avatar.color_initialized.any())


def trained(config: RGBAvatarTrainerConfig) -> RGBAvatarTrainer:
    """Train in this process, to the end."""
    trainer = make_trainer(config)
    trainer.train()
    return trainer


def finished_run(data: Path, output: Path, **fields: Any) -> Path:
    """Train in this process; the path of the run's config.yml."""
    return trained(small_config(data, output, **fields)).base_dir / "config.yml"


def newest_state(folder: Path) -> dict[str, Any]:
    """What the newest checkpoint in a folder holds."""
    return read_checkpoint(list_checkpoints(folder)[-1][1])


def parameters_of(trainer: RGBAvatarTrainer) -> torch.Tensor:
    """All of the avatar's, as one vector."""
    return torch.cat([p.detach().flatten() for p in trainer.pipeline.model.avatar.parameters()])


def program(name: str) -> str:
    """The path of one of nerfstudio's commands in this environment."""
    return str(Path(sys.executable).with_name(name))


def environment() -> Mapping[str, str]:
    """For a command: the methods are known, whether the package is installed or not."""
    here = str(Path(sys.executable).parent)
    path = here + os.pathsep + os.environ.get("PATH", "")
    own = {"NERFSTUDIO_METHOD_CONFIGS": _METHODS, "COLUMNS": "200", "PATH": path}
    return {**os.environ, **own}


def run_command(*command: str | Path) -> "subprocess.CompletedProcess[str]":
    """Run one of nerfstudio's commands to its end."""
    return run_forked([program(str(command[0])), *map(str, command[1:])], environment())
