from collections.abc import Callable
from pathlib import Path

import pytest

from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig
from tests.plugin.run import small_config, trained


@pytest.fixture
def config_of(tiny_data: Path, tmp_path: Path) -> Callable[..., RGBAvatarTrainerConfig]:
    """A small run on the tiny dataset, in a folder of the given name."""
    return lambda name="run", **fields: small_config(tiny_data, tmp_path / name, **fields)


@pytest.fixture
def train(config_of: Callable[..., RGBAvatarTrainerConfig]) -> Callable[..., RGBAvatarTrainer]:
    """Such a run, trained to its end."""
    return lambda name="run", **fields: trained(config_of(name, **fields))
