"""Training through nerfstudio's trainer: repeatable, resumable bit for bit, interruptible."""

import copy
import dataclasses
import json
import math
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._pytree import keystr, tree_flatten_with_path

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.avatar.storage.checkpoint_file import list_checkpoints
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import statistics_of
from rgbavatar_ns.plugin.methods import rgbavatar_paper
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig
from tests.plugin.run import (
    SMALL,
    assert_learns,
    before_step,
    make_trainer,
    newest_state,
    small_config,
    trained,
)

STEPS = 12
Train = Callable[..., RGBAvatarTrainer]
ConfigOf = Callable[..., RGBAvatarTrainerConfig]


def _newest(trainer: RGBAvatarTrainer) -> dict[str, Any]:
    return newest_state(trainer.checkpoint_dir)


@pytest.fixture(scope="module")
def uninterrupted(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The last checkpoint of a run from step 0 to STEPS in one go, with falling rates."""
    return _newest(trained(small_config(tiny_data, tmp_path_factory.mktemp("whole"), **_FALLING)))


_FALLING = {
    "max_num_iterations": STEPS,
    "learning_rate_factor": 0.1,
    "position_lr_final": 1e-5,
    "learning_rate_steps": STEPS,
}


def _same(first: Any, second: Any) -> bool:
    if isinstance(first, torch.Tensor):
        return first.dtype == second.dtype and torch.equal(first, second)
    return first == second


def _differences(first: Any, second: Any) -> list[str]:
    """Where two states of the same nesting differ in any bit."""
    leaves, tree = tree_flatten_with_path(first)
    others, other_tree = tree_flatten_with_path(second)
    assert tree == other_tree
    return [keystr(path) for (path, a), (_, b) in zip(leaves, others) if not _same(a, b)]


def _assert_equal_runs(first: dict[str, Any], second: dict[str, Any]) -> None:
    for name in ("step", "pipeline", "optimizers", "schedulers"):
        assert _differences(first[name], second[name]) == []


def test_a_run_equals_itself_and_not_one_of_another_seed(
    train: Train, config_of: ConfigOf, uninterrupted: dict[str, Any]
):
    again = _newest(train("again", **_FALLING))
    _assert_equal_runs(again, uninterrupted)
    config = config_of("other", **_FALLING)
    config.machine.seed = 7
    trainer = trained(config)
    assert _differences(_newest(trainer)["pipeline"], uninterrupted["pipeline"])


def test_resume_equals_uninterrupted_run(train: Train, uninterrupted: dict[str, Any]):
    half = {**_FALLING, "max_num_iterations": STEPS // 2}
    first = train("half", **half)
    assert [step for step, _ in list_checkpoints(first.checkpoint_dir)] == [STEPS // 2 - 1]
    second = train("rest", load_dir=first.checkpoint_dir, **_FALLING)
    _assert_equal_runs(_newest(second), uninterrupted)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_interrupted_run_saves_and_goes_on_as_if_nothing_had_been(
    train: Train, config_of: ConfigOf, uninterrupted: dict[str, Any], number: signal.Signals
):
    trainer = make_trainer(config_of(**_FALLING))
    before_step(4, trainer, lambda: signal.raise_signal(number))
    with pytest.raises(SystemExit) as ended:
        trainer.train()
    assert ended.value.code == 128 + number
    # The step in which the signal came is finished, saved, and not done again.
    assert [step for step, _ in list_checkpoints(trainer.checkpoint_dir)] == [4]
    resumed = train(load_dir=trainer.checkpoint_dir, **_FALLING)
    _assert_equal_runs(_newest(resumed), uninterrupted)


def test_damaged_newest_checkpoint_is_passed_over_on_resume(
    train: Train, uninterrupted: dict[str, Any], capsys: pytest.CaptureFixture[str]
):
    trainer = train(steps_per_save=8, **_FALLING)
    (_, older), (_, newest) = list_checkpoints(trainer.checkpoint_dir)
    newest.write_bytes(newest.read_bytes()[:-1000])
    capsys.readouterr()
    resumed = train(load_dir=trainer.checkpoint_dir, **_FALLING)
    told = capsys.readouterr().out
    assert newest.name in told
    assert older.name in told
    _assert_equal_runs(_newest(resumed), uninterrupted)


def test_finished_run_trains_no_further_on_resume(train: Train):
    first = train(max_num_iterations=3)
    before = list_checkpoints(first.checkpoint_dir)[-1][1].read_bytes()
    again = train(max_num_iterations=3, load_dir=first.checkpoint_dir)
    assert [step for step, _ in list_checkpoints(again.checkpoint_dir)] == [2]
    assert list_checkpoints(again.checkpoint_dir)[-1][1].read_bytes() == before
    summary = json.loads((again.base_dir / "training.json").read_text())
    assert summary["steps"] == 3
    assert summary["images"] == 12
    assert summary["images_per_second"] == pytest.approx(12 / summary["train_seconds"])


@pytest.mark.parametrize("steps", [2, 3])
def test_a_run_that_has_all_its_steps_says_that_nothing_was_trained_and_how_to_go_on(
    train: Train, capsys: pytest.CaptureFixture[str], steps: int
):
    first = train(max_num_iterations=3)
    assert "Trained 3 steps" in capsys.readouterr().out
    train(max_num_iterations=steps, load_dir=first.checkpoint_dir)
    told = " ".join(capsys.readouterr().out.split())
    assert "Trained" not in told
    assert "Nothing was trained: the run has had 3 steps before" in told
    assert f"--max-num-iterations {steps} asks for no more" in told
    train(max_num_iterations=4, load_dir=first.checkpoint_dir)
    assert "Trained 4 steps" in capsys.readouterr().out


def test_a_finished_run_resumed_under_another_name_is_whole_there_too(config_of: ConfigOf):
    first = trained(config_of(max_num_iterations=3, timestamp="first"))
    again = trained(
        config_of(max_num_iterations=3, timestamp="again", load_dir=first.checkpoint_dir)
    )
    assert again.checkpoint_dir != first.checkpoint_dir
    assert [step for step, _ in list_checkpoints(again.checkpoint_dir)] == [2]


def test_latest_leads_to_the_newest_run_that_has_a_checkpoint(config_of: ConfigOf):
    first = trained(config_of(max_num_iterations=2, timestamp="first"))
    link = first.base_dir.with_name("latest")
    assert link.resolve() == first.base_dir.resolve()
    second = make_trainer(config_of(max_num_iterations=2, timestamp="second"))
    second.config.save_config()
    assert link.resolve() == first.base_dir.resolve(), "nothing can be seen of the second one yet"
    second.train()
    assert link.resolve() == second.base_dir.resolve()
    first.save_checkpoint(1)
    assert link.resolve() == second.base_dir.resolve(), "of two at once the one begun last"
    link.unlink()
    link.mkdir()
    trained(config_of(max_num_iterations=2, timestamp="third"))
    assert not link.is_symlink()


def test_a_shorter_run_in_an_earlier_ones_folder_keeps_its_own_checkpoint(train: Train):
    first = train(max_num_iterations=6)
    shorter = train(max_num_iterations=3)
    assert shorter.checkpoint_dir == first.checkpoint_dir
    assert [step for step, _ in list_checkpoints(shorter.checkpoint_dir)] == [2]


def test_learning_rates_fall_as_asked(uninterrupted: dict[str, Any]):
    def rate(group: str) -> float:
        return uninterrupted["optimizers"][group]["param_groups"][0]["lr"]

    assert rate("position") == pytest.approx(1e-5)
    assert rate("color") == pytest.approx(1.25e-3)
    assert all(type(rate(group)) is float for group in uninterrupted["optimizers"])


def test_the_papers_method_has_its_constant_rates(config_of: ConfigOf):
    constant = rgbavatar_paper.config
    assert isinstance(constant, RGBAvatarTrainerConfig)
    fields = ("position_lr_final", "learning_rate_factor", "learning_rate_steps")
    trainer = make_trainer(config_of(**{name: getattr(constant, name) for name in fields}))
    assert trainer.optimizers.schedulers == {}
    rates = {}
    for group, optimizer in trainer.optimizers.optimizers.items():
        (settings,) = optimizer.param_groups
        assert settings["eps"] == 1e-15
        rates[group] = settings["lr"]
    # The paper's supplement.
    assert rates == {
        "position": 0.0008,
        "opacity": 0.25,
        "log_scale": 0.025,
        "rotation": 0.005,
        "color": 0.0125,
        "basis_position": pytest.approx(0.00004),
        "basis_rotation": pytest.approx(0.0025),
        "basis_color": pytest.approx(0.00625),
        "weight_network": 0.001,
    }
    assert constant.max_num_iterations == 5000
    assert constant.pipeline.datamanager.batch_size == 10
    assert constant.pipeline.model.avatar.num_bases == 20
    assert constant.pipeline.model.avatar.uv_resolution == 256


def test_positions_whose_rate_is_0_stay_where_they_are(config_of: ConfigOf):
    # The surface prior lays Gaussians upon the surface, whatever their rate.
    config = config_of(max_num_iterations=3, surface_prior=False)
    assert config.position_lr_final is not None
    config.optimizers = copy.deepcopy(config.optimizers)
    config.optimizers["position"]["optimizer"].lr = 0.0
    trainer = make_trainer(config)
    avatar = trainer.pipeline.model.avatar
    before = {name: value.detach().clone() for name, value in avatar.named_parameters()}
    trainer.train()
    moved = {n for n, value in avatar.named_parameters() if not torch.equal(value, before[n])}
    positions = {id(p) for p in avatar.parameter_groups()["position"]}
    still = {name for name, value in avatar.named_parameters() if id(value) in positions}
    assert len(still) == 1
    assert not moved & still
    assert moved


def test_training_lowers_the_loss_and_colors_gaussians(config_of: ConfigOf):
    assert_learns(make_trainer(config_of(max_num_iterations=40)))


def test_checkpoint_is_an_avatar_without_nerfstudio(train: Train):
    trainer = train(max_num_iterations=3)
    loaded = Avatar.load(trainer.base_dir)
    model = trainer.pipeline.model
    theta = model.frame_theta[:2]
    with torch.no_grad():
        expected, seen = model.avatar.gaussians(theta), loaded.gaussians(theta)
    for name in ("means", "quats_wxyz", "scales", "opacities", "colors"):
        assert torch.equal(getattr(expected, name), getattr(seen, name))


def test_checkpoint_says_what_was_filmed(train: Train, tiny_data: Path):
    trainer = train(max_num_iterations=3)
    dataset = load_dataset(tiny_data)
    expected = statistics_of(trainer.pipeline.model.avatar, dataset).to_state()
    seen = load_avatar(trainer.base_dir).training_statistics
    assert seen is not None
    for name, value in seen.to_state().items():
        assert torch.equal(torch.as_tensor(value), torch.as_tensor(expected[name])), name


def test_full_disk_at_a_checkpoint_is_a_user_error_and_the_old_one_survives(
    train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    trainer = train(max_num_iterations=3)
    usage = shutil.disk_usage(tmp_path)._replace(free=100)
    monkeypatch.setattr(
        "rgbavatar_ns.plugin.training.checkpoints.shutil.disk_usage", lambda _: usage
    )
    with pytest.raises(UserError, match="does not fit"):
        train(max_num_iterations=6, load_dir=trainer.checkpoint_dir)
    assert _newest(trainer)["step"] == 2


def test_checkpoint_of_another_make_is_refused_with_the_flags(train: Train, config_of: ConfigOf):
    first = train(max_num_iterations=2)
    other = dataclasses.replace(SMALL, num_bases=5)
    config = config_of("other", avatar=other, load_dir=first.checkpoint_dir)
    with pytest.raises(UserError, match="num_bases 3, not 5") as refused:
        make_trainer(config)
    assert "--pipeline.model.avatar.num-bases 3" in refused.value.remedy


def test_scalars_are_written_every_steps_per_log_only(train: Train):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    trainer = train()
    events = accumulator.EventAccumulator(str(trainer.base_dir))
    events.Reload()
    for name in ("Train Loss", "Train Images / Sec"):
        scalars = events.Scalars(name)
        assert [event.step for event in scalars] == [0, 10, 19]
        assert all(math.isfinite(event.value) and event.value > 0 for event in scalars)
