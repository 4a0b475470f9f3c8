"""The viewer's panel while an avatar is trained on a stream."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.plugin.checkpoint_state import model_state
from rgbavatar_ns.plugin.online.trainer import OnlineTrainer
from tests.data.streaming import Clock
from tests.plugin.fake_viewer import FakeViewer
from tests.plugin.online_run import online_config, online_trainer
from tests.plugin.run import before_each_step, newest_state
from tests.plugin.tiny import NUM_FRAMES, NUM_TEST

STREAMED = NUM_FRAMES - NUM_TEST
Online = Callable[..., OnlineTrainer]


@pytest.fixture
def online(tiny_data: Path, tmp_path: Path) -> Online:
    """A trainer that replays the tiny dataset."""
    return lambda **fields: online_trainer(online_config(tmp_path / "run", tiny_data, **fields))


@pytest.mark.parametrize("label", ["show_neutral", "show_random_expression"])
def test_the_viewer_answers_while_a_checkpoint_is_put_together(
    online: Online, label: str, monkeypatch: pytest.MonkeyPatch
):
    """Neither does a button's click meet frames that the viewer has not, nor a picture wait."""
    trainer = online()
    free: list[bool] = []

    def clicked(*given: Any) -> dict[str, Any]:
        getattr(trainer.pipeline.viewer_panel, label)()
        free.append(not trainer.train_lock._queue)
        return model_state(*given)

    monkeypatch.setattr("rgbavatar_ns.plugin.avatar_model.model_state", clicked)
    trainer.train()
    assert free
    assert all(free)
    saved = newest_state(trainer.checkpoint_dir)["pipeline"]["_model._extra_state"]
    assert len(saved["frames"]["theta"]) == saved["statistics"]["num_frames"] == STREAMED


def test_what_was_streamed_is_not_beyond_the_film_and_marks_its_sliders(online: Online):
    trainer = online()
    panel, viewer, told = trainer.pipeline.viewer_panel, FakeViewer("training"), dict[int, str]()
    panel._clock = clock = Clock()
    panel.attach(viewer)
    camera = load_dataset(trainer.config.pipeline.datamanager.data).cameras.select([0])
    jaw = viewer.gui["Jaw opens (°)"]
    assert len(jaw.options["marks"]) == 1, "one frame is known"

    def look(step: int) -> None:
        clock.now_s += 5.0
        panel.draw(camera, None)
        panel.tick()
        told[trainer.stream.pools.num_added] = "\n".join(viewer.gui.texts())

    before_each_step(trainer, look)
    trainer.train()
    assert STREAMED in told
    assert not [num for num, text in told.items() if "eyond the film" in text]
    theta = load_dataset(trainer.config.pipeline.datamanager.data).theta[:STREAMED]
    opened = theta[:, trainer.pipeline.model.avatar.layout.slice("jaw").start].rad2deg()
    ends = pytest.approx([float(opened.min()), float(opened.max())], abs=jaw.limits[2])
    assert list(jaw.options["marks"]) == ends
    assert f"to {jaw.options['marks'][-1]:g}" in jaw.options["hint"]
    drawn = []
    for _ in range(20):
        panel.show_random_expression()
        drawn.append(panel.theta_shown())
    assert torch.stack(drawn).std(0).max() > 0.02
    viewer.gui["Jaw opens (°)"].user_sets(jaw.limits[1])
    look(0)
    assert "Beyond the film: Jaw opens (°)" in "\n".join(viewer.gui.texts())
