from collections.abc import Callable
from pathlib import Path

import pytest

from rgbavatar_ns.cli.main import main
from tests.export.subject import avatar_of


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small avatar's bundle, which no test changes."""
    folder = tmp_path_factory.mktemp("avatar") / "me"
    avatar_of().save(folder)
    return folder


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that ends with 1; what it tells of the mistake."""

    def run(*words: object) -> str:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(word) for word in words])
        assert ended.value.code == 1
        told = capsys.readouterr().err
        assert "Traceback" not in told
        return told

    return run
