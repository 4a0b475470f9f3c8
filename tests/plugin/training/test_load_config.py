"""`ns-train METHOD --load-config RUN/config.yml` goes on with a run, or repeats a complete one."""

import copy
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.scripts.train import main
from nerfstudio.utils import writer
from nerfstudio.utils.eval_utils import eval_setup

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.methods import rgbavatar_tiny
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainerConfig
from tests.plugin.online_run import online_config, online_trainer
from tests.plugin.run import (
    before_step,
    finished_run,
    make_trainer,
    newest_state,
    run_command,
    small_config,
)

STEPS = 6


def typed(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> None:
    """This command line, as ns-train sees it."""
    monkeypatch.setattr(sys, "argv", ["ns-train", "rgbavatar-tiny", *map(str, words)])


def load(monkeypatch: pytest.MonkeyPatch, config: Path) -> None:
    """What `ns-train rgbavatar-tiny --load-config CONFIG` does."""
    typed(monkeypatch, "--load-config", config)
    of_command = copy.deepcopy(rgbavatar_tiny.config)
    of_command.load_config = config
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    main(of_command)


def summary(run: Path) -> dict[str, Any]:
    return json.loads((run / "training.json").read_text())


def assert_same_parameters(first: Path, second: Path) -> None:
    states = [newest_state(run / "nerfstudio_models")["pipeline"] for run in (first, second)]
    assert states[0].keys() == states[1].keys()
    for name, value in states[0].items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, states[1][name]), name


def test_a_stopped_run_goes_on_to_its_end(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    whole = finished_run(tiny_data, tmp_path / "whole", max_num_iterations=STEPS).parent
    trainer = make_trainer(small_config(tiny_data, tmp_path / "cut", max_num_iterations=STEPS))
    before_step(2, trainer, trainer.stop.request)
    trainer.train()
    run = trainer.base_dir
    assert summary(run)["ended"] == "stopped"
    load(monkeypatch, run / "config.yml")
    assert (summary(run)["ended"], summary(run)["steps"]) == ("completed", STEPS)
    assert_same_parameters(run, whole)


def test_a_complete_run_is_repeated_beside_itself(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = finished_run(tiny_data, tmp_path, max_num_iterations=STEPS)
    before = {path: path.stat().st_mtime_ns for path in config.parent.rglob("*")}
    load(monkeypatch, config)
    assert {path: path.stat().st_mtime_ns for path in config.parent.rglob("*")} == before
    (repeated,) = [
        path.parent
        for path in config.parent.parent.glob("*/config.yml")
        if path.parent.name not in ("run", "latest")
    ]
    assert_same_parameters(config.parent, repeated)
    # A run that has been gone on with was not begun elsewhere.
    assert yaml.load((repeated / "config.yml").read_text(), yaml.Loader).load_dir is None


def test_a_run_that_never_saved_begins_again(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = small_config(tiny_data, tmp_path, max_num_iterations=STEPS)
    config.save_config()
    load(monkeypatch, config.get_base_dir() / "config.yml")
    assert summary(config.get_base_dir())["steps"] == STEPS


def test_a_run_that_lies_elsewhere_than_it_says_is_not_begun_anew(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = finished_run(tiny_data, tmp_path / "before", max_num_iterations=STEPS)
    (tmp_path / "before").rename(tmp_path / "moved")
    moved = tmp_path / "moved" / config.relative_to(tmp_path / "before")
    with pytest.raises(UserError, match="but its config says") as told:
        load(monkeypatch, moved)
    assert str(moved.parent) in told.value.cause
    assert not (tmp_path / "before").exists()


def parameters(pipeline: Pipeline) -> list[torch.Tensor]:
    return list(pipeline.model.parameters())


def test_a_copied_run_is_looked_at_from_its_own_folder(tiny_data: Path, tmp_path: Path):
    """Also while the first one, which its config names, trains on."""
    first = finished_run(tiny_data, tmp_path / "runs", max_num_iterations=2)
    copied = Path(shutil.copytree(first.parent, tmp_path / "copy")) / "config.yml"
    as_copied = [value.clone() for value in parameters(eval_setup(copied)[1])]
    models = first.parent / "nerfstudio_models"
    finished_run(tiny_data, tmp_path / "runs", max_num_iterations=STEPS, load_dir=models)
    config, pipeline, checkpoint, step = eval_setup(copied)
    assert checkpoint == copied.parent / "nerfstudio_models" / "step-000000001.ckpt"
    assert step == 1
    assert all(map(torch.equal, parameters(pipeline), as_copied))
    assert config.get_base_dir() == copied.parent, "the viewer keeps its log there"
    _, pipeline, checkpoint, step = eval_setup(first)
    assert (checkpoint.parent, step) == (models, STEPS - 1)
    assert not all(map(torch.equal, parameters(pipeline), as_copied))


def test_a_moved_run_is_looked_at_where_it_is(tiny_data: Path, tmp_path: Path):
    first = finished_run(tiny_data, tmp_path / "before", max_num_iterations=2)
    moved = first.parent.rename(tmp_path / "moved")
    _, _, checkpoint, _ = eval_setup(moved / "config.yml")
    assert checkpoint.parent == moved / "nerfstudio_models"


def test_a_moved_run_of_a_stream_names_the_recording_that_is_beside_it(
    tiny_data: Path, tmp_path: Path
):
    config = online_config(tmp_path / "before", tiny_data)
    trainer = online_trainer(config)
    trainer.train()
    moved = trainer.base_dir.rename(tmp_path / "moved")
    loaded = eval_setup(moved / "config.yml")[0]
    assert loaded.pipeline.datamanager.recorded == moved / "stream"


def test_a_linked_config_is_its_runs_and_one_apart_leads_to_its_run_and_says_so(
    tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config = finished_run(tiny_data, tmp_path / "runs", max_num_iterations=1)
    moved = Path(shutil.copytree(config.parent, tmp_path / "copy"))
    (tmp_path / "best.yml").symlink_to(moved / "config.yml")
    apart = Path(shutil.copy(config, tmp_path / "apart.yml"))
    capsys.readouterr()
    assert eval_setup(tmp_path / "best.yml")[2].parent == moved / "nerfstudio_models"
    assert "note:" not in capsys.readouterr().out
    assert eval_setup(apart)[2].parent == config.parent / "nerfstudio_models"
    assert "no checkpoint lies beside" in capsys.readouterr().out
    shutil.rmtree(config.parent)
    with pytest.raises(UserError, match="no checkpoint") as told:
        eval_setup(apart)
    assert str(tmp_path / "nerfstudio_models") in told.value.cause


@pytest.mark.parametrize("option", ["--max-num-iterations", "--data", "--vis"])
def test_options_that_the_file_would_replace_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
):
    typed(monkeypatch, "--load-config", tmp_path / "config.yml", option, "7")
    with pytest.raises(UserError, match=f"{option} would not count"):
        RGBAvatarTrainerConfig(load_config=tmp_path / "config.yml")


@pytest.mark.parametrize("text", ["a: [1", "just: words", "!!python/object:no.such.Thing {}", ""])
def test_a_file_without_a_config_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
):
    path = tmp_path / "config.yml"
    path.write_text(text)
    typed(monkeypatch, "--load-config", path)
    with pytest.raises(UserError, match="holds no config"):
        RGBAvatarTrainerConfig(load_config=path)


def test_looking_at_a_file_executes_nothing_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, trace = tmp_path / "config.yml", tmp_path / "trace"
    harm = f"!!python/object/apply:os.mkdir ['{trace}']"
    path.write_text(harm)
    typed(monkeypatch, "--load-config", path)
    with pytest.raises(UserError, match="holds no config"):
        RGBAvatarTrainerConfig(load_config=path)
    path.write_text(f"!!python/object:a.TrainerConfig {{x: {harm}}}")
    RGBAvatarTrainerConfig(load_config=path)
    assert not trace.exists()
    # As nerfstudio loads it, the text does its harm.
    yaml.load(harm, yaml.Loader)
    assert trace.exists()


@pytest.mark.slow
def test_the_command_itself(tiny_data: Path, tmp_path: Path):
    config = finished_run(tiny_data, tmp_path, max_num_iterations=STEPS)
    (config.parent / "training.json").unlink()
    trained = run_command("ns-train", "rgbavatar-tiny", "--load-config", config)
    assert trained.returncode == 0, trained.stderr
    assert f"Going on with {config.parent}" in trained.stdout
    refused = run_command("ns-train", "rgbavatar-tiny", "--load-config", tmp_path / "absent.yml")
    assert refused.returncode == 1
    assert "absent.yml" in refused.stderr
    assert "Traceback" not in refused.stderr
