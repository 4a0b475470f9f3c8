from pathlib import Path

import pytest

import tests.nerfstudio_loaded  # noqa: F401  first of all: see there
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline
from tests.plugin.desk import Desk
from tests.plugin.run import small_config, trained
from tests.plugin.tiny import tiny_dataset


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a tiny dataset that no test changes."""
    folder = tmp_path_factory.mktemp("tiny") / "data"
    tiny_dataset(folder)
    return folder


@pytest.fixture(scope="module")
def pipeline(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> RGBAvatarPipeline:
    config = small_config(tiny_data, tmp_path_factory.mktemp("run"), max_num_iterations=30)
    return trained(config).pipeline.eval()


@pytest.fixture
def desk(pipeline: RGBAvatarPipeline) -> Desk:
    return Desk(pipeline)
