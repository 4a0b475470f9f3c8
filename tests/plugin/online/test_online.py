"""Training on streams through nerfstudio's trainer: pools, ends, faults, resuming."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.storage.checkpoint_file import list_checkpoints
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import rasterize
from rgbavatar_ns.plugin.methods import rgbavatar
from rgbavatar_ns.plugin.online.methods import rgbavatar_online, rgbavatar_online_tiny
from rgbavatar_ns.plugin.online.trainer import OnlineTrainer
from tests.plugin.online_run import hold_back_after, online_config, online_trainer
from tests.plugin.run import assert_learns, before_each_step, before_step, newest_state
from tests.plugin.tiny import NUM_FRAMES, NUM_TEST, SIZE

STREAMED = NUM_FRAMES - NUM_TEST
Online = Callable[..., OnlineTrainer]


@pytest.fixture
def online(tiny_data: Path, tmp_path: Path) -> Online:
    """A trainer that replays the tiny dataset and writes to a folder of the given name."""
    return lambda name="run", **fields: online_trainer(
        online_config(tmp_path / name, tiny_data, **fields)
    )


def summary(trainer: OnlineTrainer) -> dict[str, Any]:
    return json.loads((trainer.base_dir / "training.json").read_text())


def stream_state(folder: Path) -> dict[str, Any]:
    return newest_state(folder)["pipeline"]["datamanager._extra_state"]["stream"]


def test_a_replayed_stream_is_trained_on_to_its_end_and_a_little_longer(online: Online):
    trainer = online(steps_after_stream=5)
    steps_at_end = []
    before_each_step(trainer, lambda step: steps_at_end.append(trainer.stream.ended_step))
    trainer.train()
    assert trainer.completed
    # Five steps were taken after the end was noticed, and none after these.
    ended = trainer.stream.ended_step
    assert ended is not None
    assert trainer.step + 1 == ended + 5
    told = summary(trainer)
    assert told["frames"] == told["stream"]["taken in"] == STREAMED
    assert told["stream"]["dropped"] == 0
    assert told["ended"] == "completed"
    assert told["steps"] == ended + 5
    assert told["images"] <= 4 * told["steps"]
    assert list_checkpoints(trainer.checkpoint_dir)[-1][0] == trainer.step


def test_after_the_stream_the_rates_fall_to_a_tenth_also_when_resumed(online: Online):
    def rates(trainer: OnlineTrainer) -> dict[str, float]:
        optimizers = trainer.optimizers.optimizers
        return {name: each.param_groups[0]["lr"] for name, each in optimizers.items()}

    trainer = online("first", steps_after_stream=6)
    first, seen = rates(trainer), []

    def look(step: int) -> None:
        ended = trainer.stream.ended_step
        if ended is None or step <= ended:
            assert rates(trainer) == first
        else:
            seen.append(rates(trainer)["color"] / first["color"])
        if len(seen) == 3:
            trainer.shutdown()

    before_each_step(trainer, look)
    trainer.train()
    # Three steps after the first one, half of the way down to a tenth.
    assert seen == pytest.approx([10 ** (-step / 6) for step in (1, 2, 3)])
    again = online("again", steps_after_stream=6, load_dir=trainer.checkpoint_dir)
    again.train()
    for name, rate in rates(again).items():
        assert rate == pytest.approx(first[name] / 10)


def test_after_the_stream_all_kept_frames_are_drawn_alike(online: Online):
    trainer = online(local_size=2, global_size=6, local_share=1.0, steps_after_stream=120)
    drawn: Counter[int] = Counter()
    plain = trainer.stream.next_train

    def counted(step: int) -> Any:
        cameras, batch = plain(step)
        if trainer.stream.ended_step is not None:
            drawn.update(batch["position"])
        return cameras, batch

    trainer.stream.next_train = counted  # type: ignore[method-assign]
    trainer.train()
    # Four of eight frames a step: each is in half of the batches.
    assert len(drawn) == 8
    assert all(40 < count < 80 for count in drawn.values()), drawn


def test_the_streamed_avatar_learns_and_colours_its_gaussians(online: Online):
    assert_learns(online(steps_after_stream=40))


@pytest.mark.parametrize("steps_after_stream", [0, 5])
def test_what_any_kept_frame_shows_at_the_end_has_had_its_first_color(
    online: Online, tiny_data: Path, steps_after_stream: int
):
    """Of the avatar as it is saved, drawn without what the training uses for it."""
    trainer = online(steps_after_stream=steps_after_stream)
    trainer.train()
    avatar, dataset = Avatar.load(trainer.checkpoint_dir), load_dataset(tiny_data)
    held = [serial for serial, _ in trainer.stream.pools.held()]
    assert held == list(range(len(dataset.train)))
    frames = list(dataset.train)
    drawn = rasterize(
        avatar.gaussians(dataset.theta[frames]),
        dataset.cameras.select(frames),
        with_visibility=True,
    )
    assert drawn.visibility is not None
    # A weight within rounding of the threshold may fall on either side.
    shown = (drawn.visibility > 0.1 + 1e-4).any(0)
    assert int(shown.sum()) > 50
    assert avatar.color_initialized[shown].all()


def test_training_begins_with_the_first_frame(
    online: Online, tiny_data: Path, monkeypatch: pytest.MonkeyPatch
):
    hold_back_after(1, monkeypatch)
    trainer = online(max_num_iterations=2)
    trainer.train()
    assert trainer.stream.pools.num_added == 1
    assert summary(trainer)["images"] == 2
    first = load_dataset(tiny_data).theta[0]
    assert torch.equal(trainer.pipeline.model.frame_theta[0], first)


def test_a_completed_run_lets_go_of_its_stream_before_the_viewer_stays_open(
    online: Online, monkeypatch: pytest.MonkeyPatch
):
    hold_back_after(1, monkeypatch)
    trainer = online(max_num_iterations=2)
    threads: list[list[str]] = []

    def look(step: int) -> None:
        running = [one.name for one in threading.enumerate()]
        threads.append([n for n in running if n in ("rgbavatar stream", "rgbavatar ingest")])
        assert list_checkpoints(trainer.checkpoint_dir)[-1][0] == step

    where = [TrainingCallbackLocation.AFTER_TRAIN]
    trainer.callbacks.append(TrainingCallback(where, look))
    trainer.train()
    assert threads == [[]]


def test_the_viewer_knows_the_newest_frame_only(online: Online, tiny_data: Path):
    pipeline = (trainer := online()).pipeline
    assert (len(pipeline.model.frame_theta), pipeline.film) == (1, None)
    trainer.train()
    dataset = load_dataset(tiny_data)
    newest = dataset.theta[STREAMED - 1]
    assert torch.equal(pipeline.model.frame_theta[0], newest)
    assert torch.equal(pipeline.viewer_panel.theta_shown(), newest)
    pipeline.viewer_panel.show_neutral()
    assert torch.equal(pipeline.viewer_panel.theta_shown(), newest)
    recent = trainer.stream.pools.recent(float("inf"), 1)
    assert recent is not None
    score, picture = pipeline.look_at(recent)
    assert picture.shape == (SIZE, 2 * SIZE, 3)
    rgba = np.array(dataset.read_image(STREAMED - 1)).astype(float) / 255
    truth = rgba[..., :3] * rgba[..., 3:]
    assert np.abs(picture[:, :SIZE].numpy() / 255 - truth).max() < 1 / 255
    error = ((picture[:, SIZE:].numpy() / 255 - truth) ** 2).mean()
    assert score == pytest.approx(-10 * np.log10(error), abs=0.1)


def test_ctrl_c_saves_and_leaves_exit_code_0(online: Online):
    trainer = online()
    before_step(2, trainer, lambda: signal.raise_signal(signal.SIGINT))
    trainer.train()  # no SystemExit
    assert not trainer.completed
    assert [step for step, _ in list_checkpoints(trainer.checkpoint_dir)] == [2]


def test_sigterm_saves_and_is_told_by_the_exit_code(online: Online):
    trainer = online()
    before_each_step(trainer, lambda step: signal.raise_signal(signal.SIGTERM))
    with pytest.raises(SystemExit) as ended:
        trainer.train()
    assert ended.value.code == 143
    assert [step for step, _ in list_checkpoints(trainer.checkpoint_dir)] == [0]
    assert summary(trainer)["ended"] == "stopped"


def test_a_resumed_stream_goes_on_where_it_was(
    online: Online, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    sizes = {"local_size": 2, "global_size": 3}
    trainer = online("first", **sizes)
    pools = trainer.stream.pools

    def stop_in_the_middle(step: int) -> None:
        if pools.num_added == 5:
            trainer.shutdown()

    before_each_step(trainer, stop_in_the_middle)
    with monkeypatch.context() as patched:
        hold_back_after(5, patched)
        trainer.train()
    state = stream_state(trainer.checkpoint_dir)
    again = online("second", load_dir=trainer.checkpoint_dir, **sizes)
    assert again.stream.pools.num_added == state["frames"]["added"] == 5
    resumed = again.pipeline.state_dict()["datamanager._extra_state"]["stream"]["frames"]
    for name in ("serial", "index", "theta", "world_to_camera"):
        assert torch.equal(resumed[name], state["frames"][name])
    assert resumed["pools"]["local"] == state["frames"]["pools"]["local"]
    assert torch.equal(resumed["pools"]["generator"], state["frames"]["pools"]["generator"].cpu())
    again.train()
    told = summary(again)["stream"]
    # Every frame once, over both runs.
    assert told["taken in"] == told["arrived"] == STREAMED
    assert again.stream.pools.num_added == STREAMED
    finished = online("third", load_dir=again.checkpoint_dir, **sizes)
    capsys.readouterr()
    finished.train()
    assert finished.step == again.step
    told = " ".join(capsys.readouterr().out.split())
    assert "Nothing was trained" in told
    assert "--steps-after-stream 3 asks for no more" in told


def test_a_fault_of_the_source_saves_and_is_told(online: Online):
    trainer = online()
    fault = UserError("The disk is gone.", "Find it.")
    before_step(1, trainer, lambda: setattr(trainer.stream.ingest, "failure", fault))
    with pytest.raises(UserError, match="disk is gone"):
        trainer.train()
    assert [step for step, _ in list_checkpoints(trainer.checkpoint_dir)] == [1]
    assert trainer.stream.pools.num_added > 0
    assert summary(trainer)["ended"] == "failed: UserError The disk is gone. Find it."
    assert summary(trainer)["steps"] == 2


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), MemoryError("far too large"), OSError(28)])
def test_whatever_ends_a_run_it_is_told(online: Online, fault: BaseException):
    trainer = online()

    def break_off() -> None:
        raise fault

    before_step(2, trainer, break_off)
    with pytest.raises(type(fault)):
        trainer.train()
    told = summary(trainer)
    assert told["ended"].startswith(f"failed: {type(fault).__name__}")
    assert told["steps"] == 2
    assert told["stream"]["taken in"] > 0


def test_a_fault_before_the_first_frame_is_told(online: Online):
    trainer = online()
    trainer.stream.start = lambda: setattr(trainer.stream.ingest, "failure", OSError("gone"))  # type: ignore[method-assign]
    with pytest.raises(OSError, match="gone"):
        trainer.train()
    told = summary(trainer)
    assert told.pop("peak_mib") > 0
    assert told | {"stream": {}} == {
        "ended": "failed: OSError gone",
        **{"steps": 0, "train_seconds": 0.0, "images_per_second": 0.0, "images": 0, "frames": 0},
        "stream": {},
    }


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"local_share": 1.5}, "local-share is 1.5"),
        ({"final_learning_rate_factor": 0.0}, "learning-rate-factor is 0"),
        ({"local_size": 0}, "local-size is 0"),
        ({"batch_size": 0}, "batch-size is 0"),
        ({"refine_tracking": True}, "refined frame by frame"),
    ],
)
def test_impossible_flags_are_refused(online: Online, fields: dict[str, Any], told: str):
    with pytest.raises(UserError, match=told):
        online(**fields)


@pytest.mark.parametrize(
    ("kind", "told"), [("replay", "No dataset"), ("folder", "no longer"), ("video", "No video")]
)
def test_a_source_without_a_place_is_refused(tmp_path: Path, kind: Any, told: str):
    config = online_config(tmp_path)
    config.pipeline.datamanager.source.kind = kind
    with pytest.raises(UserError, match=told):
        online_trainer(config)


def test_the_methods_have_the_papers_pools_and_sizes():
    full, tiny = rgbavatar_online.config, rgbavatar_online_tiny.config
    for config in (full, tiny):
        manager = config.pipeline.datamanager
        assert (manager.local_size, manager.global_size) == (150, 1000)
        assert manager.strategy == "paper"
        assert manager.batch_size == 10
        assert manager.source.frames_per_second == 25
    # On a CPU, with few steps a frame, old frames need the larger share.
    assert full.pipeline.datamanager.local_share is None
    assert tiny.pipeline.datamanager.local_share == 0.3
    assert full.pipeline.model.avatar == rgbavatar.config.pipeline.model.avatar
    assert tiny.pipeline.model.avatar.uv_resolution == 128


def kill_while_it_runs(data: Path, output: Path, delay_s: float) -> Path:
    """Train in a process of its own, and kill it so long after its first checkpoint; the folder."""
    program = (
        "import sys, threading; from pathlib import Path; import torch; torch.set_num_threads(1); "
        "from tests.plugin.online_run import *; data, output = map(Path, sys.argv[1:]); "
        "online_trainer(online_config(output, data, steps_per_save=1, "
        "steps_after_stream=10**6)).train()"
    )
    command = [sys.executable, "-c", program, str(data), str(output)]
    with (output.parent / f"{output.name}.log").open("w") as log:
        run = subprocess.Popen(command, stdout=log, stderr=log)
    folder = output / "tiny/rgbavatar-online-tiny/run/nerfstudio_models"
    try:
        deadline = time.monotonic() + 600.0  # Importing alone takes a minute on a busy machine.
        while not list_checkpoints(folder):
            assert run.poll() is None, "it ended by itself"
            assert time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(delay_s)
        assert run.poll() is None, "it ended by itself"
    finally:
        run.kill()
        run.wait()
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2, 3))]
)
def test_a_run_that_is_killed_at_any_moment_goes_on(
    online: Online, tiny_data: Path, tmp_path: Path, seed: int
):
    delay_s = float(np.random.default_rng(seed).uniform(0, 2))
    folder = kill_while_it_runs(tiny_data, tmp_path / "killed", delay_s)
    state = stream_state(folder)
    saved = list_checkpoints(folder)[-1][0]
    leftover = folder.parent / f".{folder.name}.partial"
    if leftover.exists():
        os.utime(leftover, (0, 0))  # It was killed long ago.
    again = online("again", load_dir=folder, steps_after_stream=saved + 5)
    assert again.stream.pools.num_added == state["frames"]["added"] > 0
    again.train()
    assert again.step > saved
    assert summary(again)["frames"] == STREAMED
    assert not [path for path in tmp_path.rglob(".*")]


class _Killed(BaseException):
    """Ends a run in the middle of a step, as SIGKILL does: nothing more is saved."""


def test_a_killed_run_goes_on_from_its_last_checkpoint(
    online: Online, monkeypatch: pytest.MonkeyPatch
):
    trainer = online("first", steps_per_save=1)

    def kill() -> None:
        raise _Killed

    before_step(3, trainer, kill)
    with monkeypatch.context() as patched:
        hold_back_after(5, patched)
        with pytest.raises(_Killed):
            trainer.train()
    folder = trainer.checkpoint_dir
    assert list_checkpoints(folder)[-1][0] == 2
    state = stream_state(folder)
    again = online("again", load_dir=folder)
    assert again.stream.pools.num_added == state["frames"]["added"] > 0
    assert torch.equal(again.stream.pools.parameters()[0], state["frames"]["theta"])
    again.train()
    assert summary(again)["frames"] == STREAMED


def test_rates_that_are_to_fall_need_to_know_over_how_many_steps(online: Online):
    with pytest.raises(UserError, match="learning-rate-steps"):
        online(learning_rate_factor=0.1)
    scheduled = {"position_lr_final": 1e-6, "learning_rate_steps": 10**6}
    trainer = online("s", steps_after_stream=3, final_learning_rate_factor=0.1, **scheduled)
    first = trainer.pipeline.model.avatar.learning_rates()["color"]
    trainer.train()
    last = trainer.optimizers.optimizers["color"].param_groups[0]["lr"]
    assert last < 0.2 * first, "what has no schedule falls after the stream"
