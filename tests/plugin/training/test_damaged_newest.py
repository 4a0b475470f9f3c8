"""nerfstudio's commands take the newest checkpoint that can be read, as training and export do."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.utils.eval_utils import eval_setup

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.storage.checkpoint_file import list_checkpoints
from rgbavatar_ns.errors import UserError
from tests.plugin.run import finished_run, make_trainer, run_command, small_config


@pytest.fixture(scope="module")
def finished(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run's folder with the checkpoints of steps 2 and 3."""
    folder = tmp_path_factory.mktemp("finished")
    return finished_run(tiny_data, folder, max_num_iterations=4, steps_per_save=2).parent


@pytest.fixture
def run(finished: Path) -> Iterator[Path]:
    """Its copy at the same place, as config.yml names it; whole again afterwards."""
    kept = finished.with_name("kept")
    shutil.copytree(finished, kept)
    yield finished
    shutil.rmtree(finished)
    kept.rename(finished)


def _checkpoints(run: Path) -> list[Path]:
    return [path for _, path in list_checkpoints(run / "nerfstudio_models")]


def _damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 16
    path.write_bytes(content)


def _set_step(run: Path, step: int) -> None:
    config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    config.load_step = step
    (run / "config.yml").write_text(yaml.dump(config))


def test_the_older_one_is_taken_and_the_newest_named(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    older, newest = _checkpoints(run)
    (run / "nerfstudio_models" / "notes.txt").write_text("mine")
    assert eval_setup(run / "config.yml")[2:] == (newest, 3)
    _damage(newest)
    # As ns-viewer and ns-render load it.
    _, pipeline, path, step = eval_setup(run / "config.yml")
    assert (path, step) == (older, 2)
    assert newest.name in capsys.readouterr().out.replace("\n", "")
    parameters = Avatar.load(run).state_dict()
    for name, value in pipeline.model.avatar.state_dict().items():
        assert torch.equal(value, parameters[name])
    ComputePSNR(run / "config.yml", tmp_path / "scores.json").main()
    assert json.loads((tmp_path / "scores.json").read_text())["checkpoint"] == str(older)


def test_a_step_that_was_asked_for_is_not_replaced(run: Path):
    older, newest = _checkpoints(run)
    _set_step(run, 2)
    assert eval_setup(run / "config.yml")[2:] == (older, 2)
    _set_step(run, 3)
    _damage(newest)
    with pytest.raises(UserError, match=f"{newest.name} cannot be read"):
        eval_setup(run / "config.yml")
    _set_step(run, 9)
    with pytest.raises(UserError, match=r"no checkpoint .*step-000000009"):
        eval_setup(run / "config.yml")


def test_training_chooses_nothing_and_writes_nothing_into_its_config(run: Path, tiny_data: Path):
    for path in _checkpoints(run):
        _damage(path)
    output = run.parents[2]
    trainer = make_trainer(small_config(tiny_data, output, max_num_iterations=4))
    assert trainer.checkpoint_dir == run / "nerfstudio_models"
    assert trainer.config.load_step is None
    assert "load_step: null" in (run / "config.yml").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        ("ns-eval", "--output-path", "scores.json"),
        pytest.param(("ns-viewer",), marks=pytest.mark.nightly),
        pytest.param(
            ("ns-render", "dataset", "--output-path", "pictures"), marks=pytest.mark.nightly
        ),
    ],
    ids=lambda command: command[0],
)
def test_where_none_can_be_read_each_command_says_so(run: Path, command: tuple[str, ...]):
    for path in _checkpoints(run):
        _damage(path)
    name, *options = command
    first, rest = (options[:1], options[1:]) if name == "ns-render" else ([], options)
    ended = run_command(name, *first, "--load-config", run / "config.yml", *rest)
    assert ended.returncode == 1
    assert "None of the 2 checkpoints" in ended.stderr
    assert "Traceback" not in ended.stdout + ended.stderr


def _changed(run: Path, change: Any) -> None:
    newest = _checkpoints(run)[-1]
    state = torch.load(newest, weights_only=True)
    change(state)
    torch.save(state, newest)


def _drop(state: dict[str, Any]) -> None:
    del state["pipeline"]["_model.avatar.blendshapes.position"]


def _reshape(state: dict[str, Any]) -> None:
    state["pipeline"]["_model.avatar.blendshapes.position"] = torch.zeros(3, 3)


def _no_make(state: dict[str, Any]) -> None:
    state["pipeline"]["_model._extra_state"]["avatar"] = 7


def _misplace(state: dict[str, Any]) -> None:
    state["pipeline"]["_model.avatar.anchors.triangle_index"][0] = 10**6


@pytest.mark.parametrize("change", [_drop, _reshape, _no_make, _misplace])
def test_parameters_of_another_make_are_refused_not_passed_over(run: Path, change: Any):
    _changed(run, change)
    with pytest.raises(UserError):
        eval_setup(run / "config.yml")


def _short_moments(state: dict[str, Any]) -> None:
    state["optimizers"]["position"]["state"][0]["exp_avg"] = torch.zeros(3)


def _no_step(state: dict[str, Any]) -> None:
    state["step"] = "three"


def _other_groups(state: dict[str, Any]) -> None:
    state["optimizers"] = {"position": {"state": 1}}


@pytest.mark.parametrize("change", [_short_moments, _no_step, _other_groups])
def test_optimizers_that_do_not_fit_are_refused(
    run: Path, tiny_data: Path, tmp_path: Path, change: Any
):
    _changed(run, change)
    newest = _checkpoints(run)[-1]
    with pytest.raises(UserError):
        make_trainer(small_config(tiny_data, tmp_path, load_checkpoint=newest))
