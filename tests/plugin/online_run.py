"""Online runs in this process, small enough for a test."""

import copy
import threading
from pathlib import Path
from typing import Any

import pytest

from rgbavatar_ns.data.streams import ReplayStream, StreamedFrame
from rgbavatar_ns.plugin.online.methods import rgbavatar_online_tiny
from rgbavatar_ns.plugin.online.trainer import OnlineTrainer, OnlineTrainerConfig
from tests.plugin.run import SMALL, make_trainer, set_up


def online_config(output: Path, data: Path | None = None, **fields: Any) -> OnlineTrainerConfig:
    """rgbavatar-online-tiny with fewer Gaussians; replays `data` at 200 frames/s."""
    config = copy.deepcopy(rgbavatar_online_tiny.config)
    assert isinstance(config, OnlineTrainerConfig)
    config.pipeline.datamanager.data = data
    config.pipeline.datamanager.source.frames_per_second = 200.0
    small = {"steps_after_stream": 3, "batch_size": 4, "avatar": SMALL}
    set_up(config, output, **small | fields)
    return config


def online_trainer(config: OnlineTrainerConfig) -> OnlineTrainer:
    """What `ns-train` does up to the first step."""
    trainer = make_trainer(config)
    assert isinstance(trainer, OnlineTrainer)
    return trainer


def hold_back_after(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replayed streams stand still after so many frames."""
    given, plain, never = [], ReplayStream.next, threading.Event()

    def held(self: ReplayStream, timeout_s: float) -> StreamedFrame | None:
        if len(given) == count:
            never.wait(timeout_s)
            return None
        frame = plain(self, timeout_s)
        given.extend([] if frame is None else [frame])
        return frame

    monkeypatch.setattr(ReplayStream, "next", held)
