"""Runs whose config.yml was written before modules moved."""

import subprocess
import sys

import pytest
import yaml

EARLIER = {
    "trainer.RGBAvatarTrainerConfig": "training.trainer",
    "optimizers.AdamConfig": "training.optimizers",
    "online_trainer.OnlineTrainerConfig": "online.trainer",
    "online_pipeline.OnlinePipelineConfig": "online.pipeline",
    "online_datamanager.OnlineDataManagerConfig": "online.datamanager",
    "online_sources.SourceConfig": "online.sources",
}


@pytest.mark.parametrize("name", EARLIER)
def test_a_config_of_an_earlier_run_is_read_by_its_present_class(name: str):
    from rgbavatar_ns.plugin.online import methods as _methods  # noqa: F401

    config = yaml.load(f"!!python/object:rgbavatar_ns.plugin.{name} {{}}", Loader=yaml.Loader)
    assert type(config).__module__ == f"rgbavatar_ns.plugin.{EARLIER[name]}"
    assert type(config).__name__ == name.partition(".")[2]


def test_rates_of_an_earlier_run_fall_on_as_they_did():
    """Its config was written before there were two ways to fall."""
    from rgbavatar_ns.plugin import methods as _methods  # noqa: F401

    kind = "rgbavatar_ns.plugin.training.trainer.RGBAvatarTrainerConfig"
    config = yaml.load(f"!!python/object:{kind} {{learning_rate_factor: 0.1}}", Loader=yaml.Loader)
    assert config.learning_rate_decay == "exponential"


def test_nerfstudio_knows_them_once_it_knows_its_methods():
    """As in ns-viewer and ns-eval, which read a config by itself."""
    code = (
        "import nerfstudio.utils.eval_utils, yaml;"
        "kind = '!!python/name:rgbavatar_ns.plugin.online_trainer.OnlineTrainer';"
        "print(yaml.load(kind, Loader=yaml.Loader).__module__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "rgbavatar_ns.plugin.online.trainer"
