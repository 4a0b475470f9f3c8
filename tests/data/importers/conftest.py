"""A synthetic FLAME for all tests of importers, and a take of it without ray casting."""

from collections.abc import Callable
from pathlib import Path

import pytest

from rgbavatar_ns.synthetic.exporters import Take, TakeFrame
from rgbavatar_ns.synthetic.flame import write_synthetic_flame
from tests.data.importers.takes import make_take


@pytest.fixture(scope="session")
def flame_folder(tmp_path_factory) -> Path:
    """FLAME 2020 and 2023 in their folders."""
    folder = tmp_path_factory.mktemp("flame")
    for version in ("2020", "2023"):
        write_synthetic_flame(folder, version)
    return folder


@pytest.fixture(scope="session")
def takes(flame_folder) -> Callable[[str, bool], tuple[Take, list[TakeFrame]]]:
    """A take of a FLAME version, with or without a stiff neck; each is made once."""
    made: dict[tuple[str, bool], tuple[Take, list[TakeFrame]]] = {}

    def take(version: str, stiff_neck: bool) -> tuple[Take, list[TakeFrame]]:
        key = (version, stiff_neck)
        if key not in made:
            made[key] = make_take(flame_folder, version, stiff_neck)
        return made[key]

    return take


@pytest.fixture(scope="session", autouse=True)
def flame_is_read_once(flame_folder):
    """Reading the pickle takes a second; tests of other things share what was read."""
    from rgbavatar_ns.data.importers import flame_parameters

    known = {}
    read = flame_parameters.load_flame

    def load(path=None, **options):
        key = (str(path), *(f"{name}={value}" for name, value in sorted(options.items())))
        if path is None or flame_folder not in [path, *path.parents]:
            return read(path, **options)
        if key not in known:
            known[key] = read(path, **options)
        return known[key]

    flame_parameters.load_flame = load
    yield
    flame_parameters.load_flame = read
