"""The rivals under nerfstudio: trained, resumed, evaluated, drawn, and told from one another."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.utils import writer

from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.avatar.methods.monogaussianavatar import MonoGaussianAvatar
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.plugin.presets import presets
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainerConfig
from tests.plugin.run import make_trainer, parameters_of, run_command, set_up, small_config, trained
from tests.plugin.tiny import tiny_dataset

RIVALS = [name for name in presets() if name.endswith("-style")]
SMALL: dict[str, dict[str, Any]] = {
    "flashavatar-style": {"uv_resolution": 16, "hidden_width": 16},
    "gaussianblendshapes-style": {"num_points": 300, "num_bases": 3},
    "monogaussianavatar-style": {"steps_per_epoch": 2, "max_points": 500, "attribute_width": 16},
    "splattingavatar-style": {"initial_count": 300},
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rivals") / "data"
    tiny_dataset(folder)
    return folder


def rival_config(name: str, data: Path, output: Path, **fields: Any) -> RGBAvatarTrainerConfig:
    config = copy.deepcopy(presets()[name])
    config.pipeline.datamanager.data = data
    avatar = replace(config.pipeline.model.avatar, **SMALL.get(name, {}))
    small = {"max_num_iterations": 6, "batch_size": 2, "avatar": avatar, "lpips_metric": False}
    set_up(config, output, **small | fields)
    return config


def test_there_are_five():
    assert len(RIVALS) == 5


def test_monogaussianavatar_ends_with_all_its_points(data: Path):
    config = presets()["monogaussianavatar-style"]
    chosen: Any = config.pipeline.model.avatar
    tracked = load_dataset(data)
    avatar = MonoGaussianAvatar(HeadModel(tracked.arrays), tracked.identity, chosen)
    epochs = config.max_num_iterations // chosen.steps_per_epoch
    assert epochs == 100
    # Halving rates at epoch 80 belongs to it too.
    assert avatar.points_of(epochs) == avatar.points_of(60) == chosen.max_points == 100_000
    assert avatar.points_of(20) == 6_400


@pytest.mark.parametrize("name", RIVALS)
def test_a_run_trains_and_a_resumed_one_equals_it(name: str, data: Path, tmp_path: Path):
    whole = trained(rival_config(name, data, tmp_path / "whole"))
    assert whole.completed
    first = trained(rival_config(name, data, tmp_path / "first", max_num_iterations=3))
    going = rival_config(name, data, tmp_path / "second", load_dir=first.checkpoint_dir)
    second = trained(going)
    assert second.completed
    torch.testing.assert_close(parameters_of(second), parameters_of(whole), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", RIVALS)
def test_it_is_scored_as_tracked_and_fitted_and_drawn_by_its_file(
    name: str, data: Path, tmp_path: Path
):
    trainer = trained(rival_config(name, data, tmp_path, refine_held_out=2))
    pipeline = trainer.pipeline
    pipeline.test_mode = "test"
    scores = pipeline.get_average_eval_image_metrics()
    assert {"psnr", "psnr_refined", "ssim", "ssim_refined"} <= scores.keys()
    assert "e_orth" not in scores
    loaded, model = load_avatar(trainer.base_dir), pipeline.model
    assert loaded.method == name
    theta, camera = model.frame_theta[:1], pipeline.datamanager.dataparser.tracked.cameras
    expected = model.avatar.render(theta, camera.select([0])).image
    torch.testing.assert_close(loaded.render(theta, camera.select([0])).image, expected)
    assert expected.std() > 0.01


def test_a_checkpoint_of_another_method_is_told(data: Path, tmp_path: Path):
    first, second = RIVALS[:2]
    made = trained(rival_config(first, data, tmp_path / "first", max_num_iterations=1))
    other = rival_config(second, data, tmp_path / "second", load_dir=made.checkpoint_dir)
    with pytest.raises(UserError, match=f"avatar is one of {first}, not of {second}"):
        make_trainer(other)
    own = small_config(data, tmp_path / "third", load_dir=made.checkpoint_dir)
    with pytest.raises(UserError, match=f"avatar is one of {first}, not of rgbavatar"):
        make_trainer(own)


def test_harmonics_of_another_degree_are_told(data: Path, tmp_path: Path):
    name = "flashavatar-style"
    made = trained(rival_config(name, data, tmp_path / "first", max_num_iterations=1))
    going = rival_config(name, data, tmp_path / "second", load_dir=made.checkpoint_dir)
    model: Any = going.pipeline.model
    model.avatar = replace(model.avatar, sh_degree=1)
    with pytest.raises(UserError, match="parameters are not this model's"):
        make_trainer(going)


def test_what_density_control_did_is_logged(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = rival_config("gaussianavatars-style", data, tmp_path, max_num_iterations=7)
    avatar = config.pipeline.model.avatar
    density = replace(avatar.density, from_step=0, every=2)
    config.pipeline.model.avatar = replace(avatar, density=density)
    trainer = make_trainer(config)
    written: list[tuple[int, dict[str, Any]]] = []

    def put_dict(name: str, scalar_dict: dict[str, Any], step: int) -> None:
        if name == "Gaussians":
            written.append((step, scalar_dict))

    monkeypatch.setattr(writer, "put_dict", put_dict)
    trainer.train()
    assert [step for step, _ in written] == [1, 3, 5]
    assert written[-1][1]["count"] == trainer.pipeline.model.avatar.num_gaussians
    assert sum(figures["cloned"] + figures["split"] for _, figures in written) > 0


def test_clipped_gradients_are_told(data: Path, tmp_path: Path):
    trainer = make_trainer(rival_config(RIVALS[0], data, tmp_path))
    for group in trainer.optimizers.config.values():
        group["optimizer"].max_norm = 1.0
    with pytest.raises(UserError, match="are to be clipped, which this method does not do"):
        trainer.train()


def test_a_loss_that_is_not_finite_is_told_with_options_that_there_are(data: Path, tmp_path: Path):
    trainer = make_trainer(rival_config(RIVALS[0], data, tmp_path))
    with torch.no_grad():
        next(trainer.pipeline.model.avatar.parameters()).fill_(torch.nan)
    with pytest.raises(UserError, match=r"loss of step 0 is nan\..* --pipeline\.model\.avatar\.\*"):
        trainer.train()


@pytest.mark.slow
def test_ns_train_knows_no_option_that_the_method_does_not_have(data: Path, tmp_path: Path):
    ran = run_command(
        "ns-train", RIVALS[0], "--data", data, "--pipeline.model.surface-prior", "False"
    )
    assert ran.returncode != 0
    assert "surface-prior" in ran.stdout + ran.stderr


def test_rates_that_a_method_lets_fall_itself_are_left_to_it_or_refused(data: Path, tmp_path: Path):
    def begin(name: str, **fields: Any):
        return make_trainer(rival_config(name, data, tmp_path / name, **fields))

    trainer = begin("gaussianavatars-style", learning_rate_factor=0.1, learning_rate_steps=2)
    trainer.train()
    rates = trainer.pipeline.model.avatar.learning_rates()
    now = {n: o.param_groups[0]["lr"] for n, o in trainer.optimizers.optimizers.items()}
    assert now["color"] == pytest.approx(0.1 * rates["color"])
    assert now["position"] > 0.9 * rates["position"], "it falls over 600,000 steps"
    for name, option in (
        ("gaussianavatars-style", {"position_lr_final": 1e-5}),
        ("flashavatar-style", {"position_lr_final": 1e-5}),
        ("monogaussianavatar-style", {"learning_rate_factor": 0.1}),
    ):
        with pytest.raises(UserError, match="but the method"):
            begin(name, **option)


def test_steps_through_autograd_keep_the_memory_that_they_free(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    asked: list[str] = []
    monkeypatch.setattr(
        "rgbavatar_ns.plugin.training.trainer.keep_freed_memory", lambda: asked.append("asked")
    )
    trained(rival_config(RIVALS[0], data, tmp_path / "rival", max_num_iterations=1))
    assert asked == ["asked"]
    fused = trained(small_config(data, tmp_path / "own", max_num_iterations=1))
    assert len(asked) == 1 + (fused._take.kind == "eager")
