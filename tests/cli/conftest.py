from pathlib import Path

import pytest

from tests.export.subject import avatar_of


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small avatar's bundle, which no test changes."""
    folder = tmp_path_factory.mktemp("avatar") / "me"
    avatar_of().save(folder)
    return folder
