"""Every row of the experiments that ship trains: no two of its options refuse each other."""

import copy
import dataclasses
from pathlib import Path
from typing import Any

import pytest

from rgbavatar_ns.experiments import cells_of, read_experiment
from rgbavatar_ns.plugin.presets import presets
from tests.plugin.run import make_trainer, set_up
from tests.plugin.tiny import tiny_dataset

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))
# What makes an avatar of each kind small.
SMALL: dict[str, Any] = {
    "uv_resolution": 16,
    "num_points": 300,
    "initial_count": 300,
    "hidden_width": 16,
}


def _with(config: Any, option: str, value: Any) -> Any:
    """The config with a dotted option set; parts of it are frozen."""
    first, _, rest = option.partition(".")
    part = _with(getattr(config, first), rest, value) if rest else value
    return dataclasses.replace(config, **{first: part})


@pytest.mark.slow
@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
@pytest.mark.parametrize(
    "tiny", [pytest.param(False, marks=pytest.mark.nightly), True], ids=["full", "tiny"]
)
def test_every_row_trains(path, tiny, tmp_path):
    """Two steps of few Gaussians; LPIPS, whose network is downloaded, is left out."""
    tiny_dataset(tmp_path / "data")
    rows = {cell.variant: cell for cell in cells_of(read_experiment(path, tiny=tiny))}
    for place, cell in enumerate(rows.values()):
        config = copy.deepcopy(presets()[cell.preset])
        for option, value in cell.overrides.items():
            config = _with(config, option, value)
        config.pipeline.datamanager.data = tmp_path / "data"
        model: Any = config.pipeline.model
        for name in SMALL.keys() & vars(model.avatar).keys():
            config = _with(config, f"pipeline.model.avatar.{name}", SMALL[name])
        if hasattr(model, "lpips_weight"):
            config.pipeline.model.lpips_weight = 0.0
            config.pipeline.model.lpips_start_step = type(model).lpips_start_step
        small = {
            "max_num_iterations": 2,
            "batch_size": min(4, config.pipeline.datamanager.batch_size),
            "refine_held_out": min(2, model.refine_held_out),
        }
        set_up(config, tmp_path / str(place), **small)
        trainer = make_trainer(config)
        trainer.train()
        assert trainer.completed, cell.variant
