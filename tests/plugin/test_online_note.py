"""What an online run says in the viewer's panel and in its log."""

import base64
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.plugin.online.progress import OnlineProgress, StreamReport
from rgbavatar_ns.plugin.viewer.status_panel import StatusPanel
from tests.data.streaming import Clock
from tests.plugin.fake_viewer import FakeViewer

REPORT = StreamReport(
    step=40,
    frames=307,
    fill=(150, 157),
    images=400,
    latency_s=0.042,
    psnr=27.14,
    loss=0.0123,
    counts={"arrived": 312, "taken in": 307, "dropped": 0, "no face": 5},
)


def test_lines_name_frames_pools_rate_latency_quality_and_troubles():
    assert REPORT.lines(182.44) == [
        "frame 307",
        "pools 150 + 157",
        "182.4 images/s",
        "latency 0.04 s",
        "PSNR of the last second 27.1 dB",
        "loss 0.0123",
        "no face 5",
    ]
    scalars = REPORT.scalars()
    assert scalars["Global Pool"] == 157
    assert scalars["No face"] == 5
    assert "Dropped" not in scalars


def test_log_has_a_line_now_and_then(capsys: pytest.CaptureFixture[str]):
    with OnlineProgress() as progress:
        for _ in range(5):
            progress.show(REPORT, 10.0)
    told = capsys.readouterr().out
    assert told.count("frame 307") == 1
    assert "step 40" in told


def test_rate_is_that_of_the_last_second(monkeypatch: pytest.MonkeyPatch):
    clock = Clock()
    monkeypatch.setattr(
        "rgbavatar_ns.plugin.online.progress.time",
        SimpleNamespace(monotonic=clock),
    )
    progress = OnlineProgress()
    assert progress.images_per_second(50) == 0.0
    clock.sleep(2.0)
    assert progress.images_per_second(250) == 100.0
    clock.sleep(0.5)
    assert progress.images_per_second(300) == 100.0
    clock.sleep(0.5)
    assert progress.images_per_second(260) == 10.0


def test_note_shows_the_picture_and_keeps_it():
    note = StatusPanel("Stream")
    note.show(["before the viewer"], None)
    note._setup(viewer := FakeViewer())
    shown_note = viewer.gui["markdown"]
    rng = np.random.default_rng(0)
    picture = cv2.resize(rng.integers(0, 256, (4, 8, 3), dtype=np.uint8), (64, 32))
    note.show(["frame 1", "loss 2"], torch.from_numpy(picture))
    first, *lines = shown_note.content.split("  \n")
    assert lines == ["frame 1", "loss 2"]
    jpeg = base64.b64decode(first.removeprefix("![](data:image/jpeg;base64,").removesuffix(")"))
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(shown.astype(int) - picture).mean() < 6
    note.show(["frame 2"], None)
    assert shown_note.content == "  \n".join([first, "frame 2"])
