"""What a user can get wrong is told with cause and remedy, before or during training."""

import copy
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin import pipeline as pipeline_module
from rgbavatar_ns.plugin.pipeline import to_look_at
from rgbavatar_ns.plugin.presets import presets
from rgbavatar_ns.plugin.training.refused import REFUSED
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainerConfig
from tests.plugin.run import SMALL, make_trainer, set_up, small_config, trained
from tests.plugin.tiny import tiny_dataset


@pytest.fixture
def data(tiny_data: Path, tmp_path: Path) -> Path:
    """A copy of the tiny dataset to break."""
    return Path(shutil.copytree(tiny_data, tmp_path / "data"))


def _train(data: Path, output: Path, **fields: Any) -> None:
    make_trainer(small_config(data, output, max_num_iterations=4, **fields)).train()


def _truncate_image(data: Path) -> None:
    image = data / "images" / "00002.png"
    image.write_bytes(image.read_bytes()[:60])


@pytest.mark.parametrize("damage", [shutil.rmtree, _truncate_image])
def test_broken_dataset_is_a_user_error(data: Path, tmp_path: Path, damage: Callable[[Path], None]):
    """Told as `load_dataset` tells it, before the first step or in the middle."""
    damage(data)
    with pytest.raises(UserError) as told:
        _train(data, tmp_path / "runs")
    assert told.value.cause
    assert told.value.remedy
    named = "00002.png" if damage is _truncate_image else str(data)
    assert named in told.value.cause


def test_pictures_that_no_window_of_ssim_fits_into_are_refused_before_training(tmp_path: Path):
    for size in (10, 11):
        tiny_dataset(tmp_path / f"{size}", size=size, frames=4, test=1)
    with pytest.raises(UserError, match=r"10 x 10 pixels, fewer than the 11 a side that SSIM"):
        make_trainer(small_config(tmp_path / "10", tmp_path / "runs"))
    smallest = trained(small_config(tmp_path / "11", tmp_path / "runs", max_num_iterations=2))
    scores = smallest.pipeline.get_average_eval_image_metrics(step=2)
    assert 0 < scores["ssim"] <= 1


def _shrink_focal_length(data: Path) -> None:
    index = json.loads((data / "dataset.json").read_text())
    index["camera"]["focal_px"] = [focal_px / 4 for focal_px in index["camera"]["focal_px"]]
    (data / "dataset.json").write_text(json.dumps(index))


def _keep_only_pictures(data: Path) -> None:
    (data / "dataset.json").unlink()


@pytest.mark.parametrize("method", ["rgbavatar-tiny", "rgbavatar-online-tiny", "flashavatar-style"])
@pytest.mark.parametrize("damage", [shutil.rmtree, _keep_only_pictures, _shrink_focal_length])
def test_data_that_cannot_be_trained_on_is_told_before_a_file_is_written(
    data: Path, tmp_path: Path, method: str, damage: Callable[[Path], None]
):
    config = copy.deepcopy(presets()[method])
    config.pipeline.datamanager.data = data
    set_up(config, tmp_path / "runs")
    damage(data)
    with pytest.raises(UserError):
        config.save_config()
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("named", "told"),
    [
        ({"load_dir": Path("nowhere")}, "no checkpoint in nowhere"),
        ({"load_dir": Path("nowhere"), "load_step": 1}, "no checkpoint nowhere.*step-000000001"),
        ({"load_checkpoint": Path("nowhere.ckpt")}, "no checkpoint nowhere.ckpt"),
    ],
)
def test_what_is_not_there_to_go_on_from_is_told_before_a_file_is_written(
    tiny_data: Path, tmp_path: Path, named: dict[str, Any], told: str
):
    with pytest.raises(UserError, match=told):
        small_config(tiny_data, tmp_path / "runs", **named).save_config()
    assert not (tmp_path / "runs").exists()


def test_no_data_at_all_is_a_user_error(tmp_path: Path):
    config = small_config(Path(), tmp_path)
    config.pipeline.datamanager.data = None
    with pytest.raises(UserError, match="No dataset"):
        make_trainer(config)


def _files(folder: Path) -> dict[Path, tuple[int, bytes]]:
    """When each was written, and what stands in it."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"load_dir": Path("nowhere")}, "no checkpoint"),
        ({"steps_per_save": 0}, "steps-per-save"),
        ({"data": Path("absent")}, "absent"),
        ({"learning_rate_factor": 0.5, "learning_rate_steps": 0}, "learning-rate-steps"),
        ({"avatar": dataclasses.replace(SMALL, num_bases=2)}, "num-bases"),
    ],
)
def test_a_refused_command_changes_nothing_of_a_run_in_its_folder(
    tiny_data: Path, tmp_path: Path, change: dict[str, Any], told: str
):
    """As one does that goes on with a run by --load-dir and --timestamp, mistyped."""
    first = trained(small_config(tiny_data, tmp_path, max_num_iterations=2))
    before = _files(tmp_path)
    fields: dict[str, Any] = {"load_dir": first.checkpoint_dir, "max_num_iterations": 4} | change
    data = fields.pop("data", tiny_data)
    with pytest.raises(UserError, match=told):
        make_trainer(small_config(data, tmp_path, **fields))
    assert _files(tmp_path) == before
    fields = {"load_dir": first.checkpoint_dir, "max_num_iterations": 4}
    make_trainer(small_config(tiny_data, tmp_path, **fields))
    written = yaml.load((first.base_dir / "config.yml").read_text(), yaml.Loader)
    assert written.max_num_iterations == 4, "one that is not refused is written down"
    assert written.pipeline.datamanager.seed is None, "as it was asked for"


def test_theta_of_another_layout_than_the_checkpoints_is_refused_by_name(
    data: Path, tmp_path: Path
):
    make_trainer(small_config(data, tmp_path / "runs", max_num_iterations=2)).train()
    checkpoints = tmp_path / "runs" / "tiny" / "rgbavatar-tiny" / "run" / "nerfstudio_models"
    size = np.load(data / "theta.npy").shape[1]
    tiny_dataset(tmp_path / "fewer", fewer_expressions=1)
    with pytest.raises(UserError) as told:
        _train(tmp_path / "fewer", tmp_path / "other", load_dir=checkpoints)
    assert f"{size} values" in told.value.cause
    assert f"{size - 1} values" in told.value.cause


def test_foreign_checkpoint_is_refused(data: Path, tmp_path: Path):
    state = {"step": 0, "pipeline": {}, "optimizers": {}, "schedulers": {}, "scalers": {}}
    folder = tmp_path / "foreign"
    folder.mkdir()
    torch.save(state, folder / "step-000000000.ckpt")
    with pytest.raises(UserError, match="no avatar of this method"):
        _train(data, tmp_path / "runs", load_dir=folder)


def _set(config: RGBAvatarTrainerConfig, path: str, value: Any) -> None:
    *owners, name = path.split(".")
    owner: Any = config
    for part in owners:
        owner = owner[part] if isinstance(owner, dict) else getattr(owner, part)
    object.__setattr__(owner, name, value)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("max_num_iterations", -3),
        ("steps_per_save", 0),
        ("machine.seed", -1),
        ("machine.num_devices", 2),
        ("logging.steps_per_log", 0),
        ("viewer.websocket_port", 10**6),
        ("pipeline.model.avatar.num_bases", 10**9),
        ("pipeline.model.avatar.uv_resolution", 0),
        ("pipeline.datamanager.batch_size", 0),
        ("optimizers.position.optimizer.lr", float("nan")),
    ],
)
def test_options_out_of_range_are_told_by_their_name_before_a_file_is_written(
    tiny_data: Path, tmp_path: Path, option: str, value: Any
):
    config = copy.deepcopy(small_config(tiny_data, tmp_path / "runs"))
    _set(config, option, value)
    with pytest.raises(UserError) as told:
        config.save_config()
    assert f"--{option.replace('_', '-')} is {value}" in told.value.cause
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("gradient_accumulation_steps", {"color": 4}),
        ("log_gradients", True),
        ("mixed_precision", True),
        ("use_grad_scaler", True),
        ("prompt", "a head"),
        ("pipeline.model.prompt", "a head"),
        ("pipeline.model.enable_collider", True),
        ("machine.num_machines", 2),
        ("machine.machine_rank", 1),
        ("machine.dist_url", "tcp://127.0.0.1:8686"),
        ("logging.profiler", "pytorch"),
        ("viewer.num_rays_per_chunk", 1024),
        ("relative_model_dir", Path("elsewhere")),
        ("vis", "viewer_legacy"),
        ("start_paused", True),
    ],
)
def test_options_that_would_change_nothing_are_refused_before_a_file_is_written(
    tiny_data: Path, tmp_path: Path, option: str, value: Any
):
    config = copy.deepcopy(small_config(tiny_data, tmp_path / "runs"))
    _set(config, option, value)
    with pytest.raises(UserError) as told:
        config.save_config()
    assert told.value.cause.startswith(f"--{option.replace('_', '-')} ")
    assert told.value.remedy
    assert not (tmp_path / "runs").exists()


STAY: dict[str, Any] = {"position_lr_final": None, "learning_rate_factor": 1.0}


@pytest.mark.parametrize(
    ("method", "option", "value", "without", "beside"),
    [
        ("rgbavatar-paper", "learning_rate_steps", 3000, {}, {"learning_rate_factor": 0.1}),
        ("rgbavatar-paper", "learning_rate_steps", 3000, {}, {"position_lr_final": 1e-5}),
        ("rgbavatar-paper", "learning_rate_steps", 3000, {}, {"refine_tracking": True}),
        ("rgbavatar-paper", "learning_rate_decay", "linear", {}, {"learning_rate_factor": 0.1}),
        ("rgbavatar-quick", "learning_rate_steps", 3000, STAY, {}),
        ("gaussianavatars-style", "learning_rate_steps", 99, {}, {"learning_rate_factor": 0.1}),
        ("monogaussianavatar-style", "learning_rate_steps", 99, {}, None),
        ("rgbavatar", "first_colors", "paper", {"initialize_colors": False}, {}),
        ("rgbavatar", "lpips_start_step", 9, {}, {"lpips_weight": 0.05}),
        ("rgbavatar", "refine_held_out_frames", 9, {}, {"refine_held_out": 5}),
    ],
)
def test_options_that_count_beside_another_one_are_refused_without_it(
    tiny_data: Path,
    tmp_path: Path,
    method: str,
    option: str,
    value: Any,
    without: dict[str, Any],
    beside: dict[str, Any] | None,
):
    def saved(**fields: Any) -> None:
        config = copy.deepcopy(presets()[method])
        config.pipeline.datamanager.data = tiny_data
        set_up(config, tmp_path, **fields)
        config.save_config()

    with pytest.raises(UserError, match=f"--.*{option.replace('_', '-')} is {value}, but"):
        saved(**{option: value}, **without)
    assert not any(tmp_path.iterdir())
    if beside is not None:
        saved(**{option: value}, **beside)
    saved(**without)  # as the preset has it


def test_the_page_names_every_option_that_is_refused():
    page = (Path(__file__).parents[2] / "docs" / "nerfstudio.md").read_text()
    for refused in REFUSED:
        assert refused.option.rpartition(".")[2].replace("_", "-") in page


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("gpu", "cannot be used here .available: .*cpu"),
        ("cuda", "rasterizer is cuda, which"),
        ("reference", None),
    ],
)
def test_a_rasterizer_that_cannot_draw_here_is_told(
    tiny_data: Path, tmp_path: Path, name: str, told: str | None
):
    config = copy.deepcopy(small_config(tiny_data, tmp_path / "runs", rasterizer=name))
    if told is None:
        config.save_config()
        return
    with pytest.raises(UserError, match=told):
        config.save_config()
    assert not (tmp_path / "runs").exists()


def test_a_run_of_another_machine_is_looked_at_with_what_there_is(
    monkeypatch: pytest.MonkeyPatch,
):
    config = copy.deepcopy(small_config(Path("data"), Path("runs"), rasterizer="cuda")).pipeline
    looked, device = to_look_at(config, "cpu")
    assert (looked.model.rasterizer, device) == ("auto", "cpu")
    assert config.model.rasterizer == "cuda", "the run's own config stays"
    config.model.rasterizer = "cpu"
    monkeypatch.setattr(pipeline_module, "available_backends", lambda: ("cuda", "cpu"))
    looked, device = to_look_at(config, "cuda:0")
    assert (looked.model.rasterizer, device) == ("auto", "cuda:0")
    monkeypatch.setattr(pipeline_module, "available_backends", lambda: ("cpu", "reference"))
    looked, device = to_look_at(config, "cuda:0")
    assert (looked.model.rasterizer, device) == ("cpu", "cpu"), "no kernels, no crawling picture"


def test_a_dataset_that_was_tracked_anew_is_told(
    tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    trainer = trained(small_config(tiny_data, tmp_path / "runs", max_num_iterations=1))
    assert "measured otherwise" not in capsys.readouterr().out
    anew = Path(shutil.copytree(tiny_data, tmp_path / "anew"))
    index = json.loads((anew / "dataset.json").read_text())
    index["identity"][0] += 0.5
    (anew / "dataset.json").write_text(json.dumps(index))
    make_trainer(small_config(anew, tmp_path / "more", load_dir=trainer.checkpoint_dir))
    assert "was measured otherwise than this data's" in capsys.readouterr().out


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_told(tiny_data: Path, tmp_path: Path):
    config = small_config(tiny_data, tmp_path / "runs")
    config.machine.device_type = "cuda"
    with pytest.raises(UserError, match="no device of the type 'cuda'"):
        config.save_config()


def test_a_place_that_cannot_be_written_is_told_at_the_start(tiny_data: Path, tmp_path: Path):
    (tmp_path / "file").write_text("mine")
    config = small_config(tiny_data, tmp_path / "file" / "runs")
    with pytest.raises(UserError, match="Cannot write"):
        config.save_config()


def test_the_step_that_a_run_goes_on_from_is_not_written(tiny_data: Path, tmp_path: Path):
    config = small_config(tiny_data, tmp_path, load_step=7)
    config.save_config()
    written = yaml.load((config.get_base_dir() / "config.yml").read_text(), yaml.Loader)
    assert (written.load_step, config.load_step) == (None, 7)
