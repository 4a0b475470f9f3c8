"""`--vis wandb` and `--vis comet`: stand-ins for their packages, and wandb itself offline."""

import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.host_commands import told_of_command
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer
from tests.plugin.run import make_trainer, run_command, small_config

STEPS = 9
EVALUATED = {"steps_per_eval_batch": 4, "steps_per_eval_image": 4, "steps_per_eval_all_images": 4}


class Service:
    """What was logged: (name, step, value)."""

    def __init__(self) -> None:
        self.config: Any = None
        self.logged: list[tuple[str, int, Any]] = []

    def names(self) -> set[str]:
        return {name for name, _, _ in self.logged}


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> Service:
    service, module = Service(), types.ModuleType("wandb")

    def log(values: dict[str, Any], step: int) -> None:
        service.logged += [(name, step, value) for name, value in values.items()]

    def update(config: Any, allow_val_change: bool) -> None:
        service.config = config

    members = {
        "init": lambda **_: None,
        "log": log,
        "Image": lambda image: image,
        "config": types.SimpleNamespace(update=update),
    }
    for name, member in members.items():
        setattr(module, name, member)
    monkeypatch.setitem(sys.modules, "wandb", module)
    return service


@pytest.fixture
def comet(monkeypatch: pytest.MonkeyPatch) -> Service:
    service, module = Service(), types.ModuleType("comet_ml")

    class Experiment:
        def __init__(self, project_name: str) -> None:
            assert project_name

        def set_name(self, name: str) -> None:
            assert name == "tiny"

        def log_image(self, image: Any, name: str, step: int) -> None:
            service.logged.append((name, step, image))

        def log_metric(self, name: str, value: Any, step: int) -> None:
            service.logged.append((name, step, value))

        def log_parameters(self, config: Any, step: int) -> None:
            service.config = config

    module.Experiment = Experiment  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "comet_ml", module)
    return service


@pytest.mark.parametrize("name", ["wandb", "comet"])
def test_scalars_and_pictures_of_training_arrive(
    name: str, tiny_data: Path, tmp_path: Path, request: pytest.FixtureRequest
):
    service: Service = request.getfixturevalue(name)
    config = small_config(tiny_data, tmp_path, vis=name, max_num_iterations=STEPS, **EVALUATED)
    config.logging.steps_per_log = 2
    make_trainer(config).train()
    losses = [(step, float(value)) for key, step, value in service.logged if key == "Train Loss"]
    assert [step for step, _ in losses] == [0, 2, 4, 6, 8]
    assert losses[-1][1] < losses[0][1]
    assert {"Train Images / Sec", "learning_rate/color", "Eval Loss"} <= service.names()
    assert "Eval Images Metrics Dict (all images)/psnr" in service.names()
    pictures = [value for key, _, value in service.logged if key.startswith("Eval Images/")]
    assert pictures
    assert all(isinstance(picture, torch.Tensor) for picture in pictures)
    assert service.config["method_name"] == "rgbavatar-tiny"
    # A service may refuse a step that lies before the last one.
    steps = [step for _, step, _ in service.logged]
    assert steps == sorted(steps)


def _no_account(**_: Any) -> None:
    raise ValueError("an API key is wanted\nand much more")


def _told(start: Callable[[], RGBAvatarTrainer]) -> str:
    with pytest.raises((ValueError, ImportError)) as raised:
        start()
    told = told_of_command(raised.value, raised.tb)
    assert isinstance(told, UserError)
    return str(told)


@pytest.mark.parametrize(
    ("name", "entrance", "remedy"),
    [("wandb", "init", "wandb login"), ("comet_ml", "Experiment", "COMET_API_KEY")],
)
def test_a_service_without_account_or_package_is_told(
    name: str,
    entrance: str,
    remedy: str,
    tiny_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    vis = name.removesuffix("_ml")
    module = types.ModuleType(name)
    setattr(module, entrance, _no_account)
    monkeypatch.setitem(sys.modules, name, module)
    told = _told(lambda: make_trainer(small_config(tiny_data, tmp_path, vis=vis)))
    assert "an API key is wanted" in told
    assert "much more" not in told
    assert remedy in told
    monkeypatch.setitem(sys.modules, name, None)
    assert name in _told(lambda: make_trainer(small_config(tiny_data, tmp_path, vis=vis)))


@pytest.mark.nightly
def test_wandb_itself_takes_a_run_offline(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("WANDB_MODE", "offline")
    flags = "--pipeline.model.avatar.uv-resolution 16 --max-num-iterations 6 --timestamp run"
    trained = run_command(
        *("ns-train", "rgbavatar-tiny", "--data", tiny_data, "--output-dir", tmp_path),
        *(*flags.split(), "--vis", "wandb", "--logging.steps-per-log", "2"),
        *("--steps-per-eval-image", "2", "--steps-per-eval-batch", "2"),
    )
    assert trained.returncode == 0, trained.stdout + trained.stderr
    assert list(tmp_path.glob("data/rgbavatar-tiny/run/wandb/offline-run-*/*.wandb"))
