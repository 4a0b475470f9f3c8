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
from rgbavatar_ns.plugin.methods import rgbavatar_tiny
from rgbavatar_ns.plugin.training.checkpoints import list_checkpoints, read_checkpoint
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig

SMALL = AvatarConfig(uv_resolution=16, num_bases=3, hidden_width=16, scale_from_texel_spacing=True)
# Entry points exist only once the package is installed; the variable works without.
_METHODS = (
    "rgbavatar=rgbavatar_ns.plugin.methods:rgbavatar,"
    "rgbavatar-tiny=rgbavatar_ns.plugin.methods:rgbavatar_tiny"
)


def small_config(
    data: Path,
    output: Path,
    avatar: AvatarConfig = SMALL,
    lpips_metric: bool = False,
    **fields: Any,
) -> RGBAvatarTrainerConfig:
    """rgbavatar-tiny with fewer Gaussians and steps, writing to `output`."""
    config = copy.deepcopy(rgbavatar_tiny.config)
    assert isinstance(config, RGBAvatarTrainerConfig)
    config.output_dir = output
    config.experiment_name = "tiny"
    config.timestamp = "run"
    config.vis = "tensorboard"
    config.max_num_iterations = 20
    config.machine.device_type = "cpu"
    config.pipeline.datamanager.data = data
    config.pipeline.datamanager.batch_size = 4
    config.pipeline.model.avatar = avatar
    config.pipeline.model.lpips_metric = lpips_metric
    for name, value in fields.items():
        assert hasattr(config, name)
        setattr(config, name, value)
    return config


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


def environment(**changes: str) -> Mapping[str, str]:
    """For a command: the methods are known, whether the package is installed or not."""
    here = str(Path(sys.executable).parent)
    own = {
        "NERFSTUDIO_METHOD_CONFIGS": _METHODS,
        "COLUMNS": "200",
        "PATH": here + os.pathsep + os.environ.get("PATH", ""),
    }
    return {**os.environ, **own, **changes}


def run_command(
    *command: str | Path, timeout_s: float = 600, **changes: str
) -> "subprocess.CompletedProcess[str]":
    """Run one of nerfstudio's commands to its end."""
    return subprocess.run(
        [program(str(command[0])), *map(str, command[1:])],
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout_s,
        env=environment(**changes),
    )
