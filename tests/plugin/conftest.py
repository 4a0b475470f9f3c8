from pathlib import Path

import pytest

from tests.plugin.tiny import tiny_dataset


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a tiny dataset that no test changes."""
    folder = tmp_path_factory.mktemp("tiny") / "data"
    tiny_dataset(folder)
    return folder
