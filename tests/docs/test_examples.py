"""The Python of docs/extend.md and docs/python.md does what the pages say: it is run, in order."""

import json
import re
import shutil
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.training.method_step import MethodStep
from rgbavatar_ns.data import ImageCache, load_dataset
from rgbavatar_ns.data.importers import FORMATS
from rgbavatar_ns.data.importers import formats as formats_module
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import rasterize, registry
from tests.kernels.scenes import in_float32, random_scene
from tests.plugin.tiny import tiny_dataset

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page: str) -> list[str]:
    """The Python of a page, in order."""
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), flags=re.S)


def run(sources: list[str], name: str) -> dict[str, Any]:
    """Run blocks one after another as one module; what it then holds."""
    module = ModuleType(name)
    for source in sources:
        exec(compile(source, f"{name}, in the docs", "exec"), module.__dict__)
    return module.__dict__


@pytest.fixture(scope="module")
def data_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_dataset(tmp_path_factory.mktemp("tiny") / "me").root


@pytest.fixture
def here(data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with data/me, which is where the pages' commands are given."""
    shutil.copytree(data_folder, tmp_path / "data" / "me")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_method_learns_is_kept_and_moves_with_the_head(here: Path) -> None:
    held = run(blocks("extend.md")[:2], "extend_method")
    data, avatar, again = held["data"], held["avatar"], held["again"]
    fresh = held["Dots"](HeadModel(data.arrays), data.identity)
    theta, camera = data.theta[list(data.test)], data.cameras.select(data.test)
    images = ImageCache(data, budget_bytes=1 << 24)
    target = images.get(data.test)[..., :3].float() / 255
    images.close()

    def error(method: Any) -> float:
        return float((method.render(theta, camera).image - target).abs().mean())

    assert error(avatar) < 0.7 * error(fresh)
    torch.testing.assert_close(
        again.render(theta, camera).image, avatar.render(theta, camera).image
    )
    moved = theta.clone()
    moved[:, data.layout.slice("translation")] += torch.tensor([0.01, 0.0, 0.0])
    step = avatar.gaussians(moved).means - avatar.gaussians(theta).means
    torch.testing.assert_close(step, torch.tensor([0.01, 0, 0]).expand_as(step), atol=1e-6, rtol=0)
    assert MethodStep(avatar).optimizers[0].param_groups[0]["lr"] == 0.02


def test_the_format_is_read_as_what_was_written(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = run(blocks("extend.md")[2:3], "extend_format")
    monkeypatch.setattr(formats_module, "FORMATS", (*FORMATS, held["TAKE"]))
    mine, take = load_dataset("data/me"), Path("data/take")
    take.mkdir()
    jaw = mine.layout.slice("jaw")
    content = {
        "world_to_camera": mine.cameras.world_to_camera[0].tolist(),
        "focal_px": mine.cameras.focal_px[0].tolist(),
        "principal_point_px": mine.cameras.principal_point_px[0].tolist(),
        "frames": [
            {"image": f"{place}.png", "jaw": mine.theta[place, jaw].tolist()} for place in range(5)
        ],
    }
    for place in range(5):
        shutil.copy(f"data/me/images/{place:05d}.png", take / f"{place}.png")
    (take / "take.json").write_text(json.dumps(content))
    data = load_dataset(take)
    assert data.source["format"] == "my tracker's take"
    assert (data.train, data.test) == ((0, 1, 2, 3), (4,))
    torch.testing.assert_close(data.theta[:, jaw], mine.theta[:5, jaw])
    np.testing.assert_array_equal(data.read_image(3), mine.read_image(3))


def test_the_backend_draws_as_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    held = run(["import torch", *blocks("extend.md")[3:4]], "extend_backend")
    loaded = registry._load
    backend = held["load"]()
    monkeypatch.setitem(registry._LOADERS, "double", "extend_backend")
    monkeypatch.setattr(
        registry, "_load", lambda name: backend if name == "double" else loaded(name)
    )
    gaussians, cameras = in_float32(random_scene(seed=4))
    drawn = rasterize(gaussians, cameras, backend="double", with_depth=True)
    reference = rasterize(gaussians, cameras, backend="reference", with_depth=True)
    assert drawn.image.dtype == torch.float32
    torch.testing.assert_close(drawn.image, reference.image, atol=1e-5, rtol=0)
    torch.testing.assert_close(drawn.depth, reference.depth, atol=1e-4, rtol=0)


def test_the_tour_of_python(here: Path) -> None:
    data = load_dataset("data/me")
    config = AvatarConfig(uv_resolution=16, num_bases=2, hidden_width=8)
    Avatar(HeadModel(data.arrays), data.identity, config).save(here / "outputs" / "me")
    held = SimpleNamespace(**run(blocks("python.md"), "python_page"))
    assert held.image.shape == (10, data.height, data.width, 3)
    assert held.opened.shape == (data.height, data.width, 3)
    assert float((held.opened - held.picture.image[0]).abs().max()) > 0.1
    assert held.alpha.shape == (1, data.height, data.width, 1)
    assert Avatar.load("me.avatar").num_gaussians == held.avatar.num_gaussians
    assert held.fresh.parameter_groups()["color"][0].std() > 0.01
    mine = load_dataset("data/mine")
    assert (len(mine.train), len(mine.test)) == (3, 1)
    np.testing.assert_array_equal(mine.read_image(0), data.read_image(data.train[0]))
    red = held.dot[0, 32, 32]
    assert red[0] > 0.9
    assert red[1:].max() == 0
