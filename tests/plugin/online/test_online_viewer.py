"""The viewer's panel while an avatar is trained on a stream."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rgbavatar_ns.plugin.checkpoint_state import model_state
from rgbavatar_ns.plugin.online.trainer import OnlineTrainer
from tests.plugin.online_run import online_config, online_trainer
from tests.plugin.run import newest_state
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
