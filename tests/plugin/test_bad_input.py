"""What a user can get wrong is told with cause and remedy, before or during training."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.errors import UserError
from tests.plugin.run import make_trainer, small_config
from tests.plugin.tiny import tiny_dataset


@pytest.fixture
def data(tiny_data: Path, tmp_path: Path) -> Path:
    """A copy of the tiny dataset to break."""
    return Path(shutil.copytree(tiny_data, tmp_path / "data"))


def _train(data: Path, output: Path, **fields: Any) -> None:
    make_trainer(small_config(data, output, max_num_iterations=4, **fields)).train()


def _truncate_image(data: Path) -> None:
    image = data / "images" / "00002.png"
    image.write_bytes(image.read_bytes()[:60])


@pytest.mark.parametrize("damage", [shutil.rmtree, _truncate_image])
def test_broken_dataset_is_a_user_error(data: Path, tmp_path: Path, damage: Callable[[Path], None]):
    """Told as `load_dataset` tells it, before the first step or in the middle."""
    damage(data)
    with pytest.raises(UserError) as told:
        _train(data, tmp_path / "runs")
    assert told.value.cause
    assert told.value.remedy
    named = "00002.png" if damage is _truncate_image else str(data)
    assert named in told.value.cause


def test_no_data_at_all_is_a_user_error(tmp_path: Path):
    config = small_config(Path(), tmp_path)
    config.pipeline.datamanager.data = None
    with pytest.raises(UserError, match="No dataset"):
        make_trainer(config)


def test_theta_of_another_layout_than_the_checkpoints_is_refused_by_name(
    data: Path, tmp_path: Path
):
    make_trainer(small_config(data, tmp_path / "runs", max_num_iterations=2)).train()
    checkpoints = tmp_path / "runs" / "tiny" / "rgbavatar-tiny" / "run" / "nerfstudio_models"
    size = np.load(data / "theta.npy").shape[1]
    tiny_dataset(tmp_path / "fewer", fewer_expressions=1)
    with pytest.raises(UserError) as told:
        _train(tmp_path / "fewer", tmp_path / "other", load_dir=checkpoints)
    assert f"{size} values" in told.value.cause
    assert f"{size - 1} values" in told.value.cause


def test_foreign_checkpoint_is_refused(data: Path, tmp_path: Path):
    state = {"step": 0, "pipeline": {}, "optimizers": {}, "schedulers": {}, "scalers": {}}
    folder = tmp_path / "foreign"
    folder.mkdir()
    torch.save(state, folder / "step-000000000.ckpt")
    with pytest.raises(UserError, match="no avatar of this method"):
        _train(data, tmp_path / "runs", load_dir=folder)
