"""nerfstudio's commands with this method, as its users expect of them."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.scripts.render import RenderInterpolated
from PIL import Image

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.drawing.compositing import composite_bytes
from rgbavatar_ns.plugin.dataparser import RGBAvatarDataParserConfig, rgbavatar_data
from rgbavatar_ns.plugin.errors import install_user_error_hook
from tests.plugin.run import environment, finished_run, make_trainer, program, small_config
from tests.plugin.tiny import NUM_TEST


@pytest.fixture(scope="module")
def config(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run's config.yml."""
    return finished_run(tiny_data, tmp_path_factory.mktemp("run"), max_num_iterations=5)


def told(*command: str | Path, **more: str) -> "subprocess.CompletedProcess[str]":
    """Run a command whose environment has `more`."""
    return subprocess.run(
        [program(str(command[0])), *map(str, command[1:])],
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
        env={**environment(), **more},
    )


@pytest.mark.slow
@pytest.mark.parametrize("pose_source", ["eval", "train"])
def test_interpolate_films_the_performance_and_no_still_face(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pose_source: Any
):
    # nerfstudio asks for ffmpeg, also where it writes single images.
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    (tmp_path / "ffmpeg").symlink_to(ffmpeg)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    film = tmp_path / "film.mp4"
    RenderInterpolated(
        config,
        output_path=film,
        image_format="png",
        output_format="images",
        pose_source=pose_source,
        interpolation_steps=3,
    ).main()
    paths = sorted(film.with_suffix("").iterdir())
    pictures = [np.asarray(Image.open(path)).astype(int) for path in paths]
    if pose_source == "eval":
        assert len(pictures) == 3 * (NUM_TEST - 1)
    # All cameras are one: what moves is the face.
    changes = [np.abs(second - first).max() for first, second in zip(pictures[::3], pictures[2::3])]
    assert min(changes) > 10


@pytest.mark.slow
def test_a_path_for_rays_is_answered_with_our_own_commands(config: Path, tmp_path: Path):
    ended = told(
        "ns-render", "spiral", "--load-config", config, "--output-path", tmp_path / "a.mp4"
    )
    assert ended.returncode == 1
    assert "rgbavatar render RUN OUT --show turntable" in ended.stderr
    assert "Traceback" not in ended.stdout + ended.stderr


@pytest.mark.parametrize(
    ("module", "command"),
    [
        ("nerfstudio.scripts.exporter", "rgbavatar export RUN DST --format ply"),
        ("nerfstudio.scripts.render", "rgbavatar render RUN OUT"),
    ],
)
def test_a_refusal_of_the_host_names_the_command_that_does_it(
    module: str, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """ns-export itself needs Open3D, whose import fails where libusb is missing."""
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    install_user_error_hook()
    for name, words in ((module, command), ("elsewhere", "Traceback")):
        trace = assertion_in(name)
        sys.excepthook(AssertionError, AssertionError("not Splatfacto"), trace)
        assert words in capsys.readouterr().err


def assertion_in(module: str) -> TracebackType:
    """Where an assertion of a module failed."""
    with pytest.raises(AssertionError) as caught:
        exec("def main():\n    assert False\nmain()", {"__name__": module})
    return caught.tb


@pytest.mark.slow
def test_a_saved_config_trains_again(config: Path):
    summary = config.with_name("training.json")
    summary.unlink()
    again = told("ns-train", "rgbavatar-tiny", "--load-config", config)
    assert again.returncode == 0, again.stdout + again.stderr
    assert json.loads(summary.read_text())["steps"] == 5


@pytest.mark.slow
def test_curves_go_to_weights_and_biases(tiny_data: Path, tmp_path: Path):
    flags = "--pipeline.model.avatar.uv-resolution 16 --max-num-iterations 6 --timestamp run"
    trained = told(
        *("ns-train", "rgbavatar-tiny", "--data", tiny_data, "--output-dir", tmp_path),
        *(*flags.split(), "--vis", "wandb", "--logging.steps-per-log", "2"),
        *("--steps-per-eval-image", "2", "--steps-per-eval-batch", "2"),
        WANDB_MODE="offline",
    )
    assert trained.returncode == 0, trained.stdout + trained.stderr
    assert list(tmp_path.glob("data/rgbavatar-tiny/run/wandb/offline-run-*/*.wandb"))


def test_curves_go_to_comet(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A stand-in for its client: comet itself takes nothing without a key."""
    scalars: dict[str, list[float]] = {}

    class Experiment:
        def __init__(self, **_: str) -> None: ...
        def set_name(self, name: str) -> None: ...
        def log_parameters(self, *_: Any, **__: Any) -> None: ...
        def log_image(self, *_: Any, **__: Any) -> None: ...
        def log_metric(self, name: str, value: Any, step: int) -> None:
            scalars.setdefault(name, []).append(float(value))

    monkeypatch.setitem(sys.modules, "comet_ml", type("comet_ml", (), {"Experiment": Experiment}))
    trainer = make_trainer(small_config(tiny_data, tmp_path, vis="comet", max_num_iterations=12))
    trainer.train()
    assert len(scalars["Train Loss"]) >= 2
    assert all(np.isfinite(value) for values in scalars.values() for value in values)


@pytest.mark.slow
def test_other_methods_list_the_dataparser_by_its_name(tiny_data: Path):
    listed = told(
        *("ns-train", "nerfacto", "rgbavatar-data", "--help"),
        NERFSTUDIO_DATAPARSER_CONFIGS=(
            "rgbavatar-data=rgbavatar_ns.plugin.dataparser:rgbavatar_data"
        ),
    )
    assert listed.returncode == 0, listed.stdout + listed.stderr
    assert "--importing.region" in listed.stdout
    assert isinstance(rgbavatar_data.config, RGBAvatarDataParserConfig)


def test_a_data_manager_of_nerfstudios_reads_frames_over_black(tiny_data: Path):
    dataparser = RGBAvatarDataParserConfig(data=tiny_data)
    settings = VanillaDataManagerConfig(dataparser=dataparser, train_num_rays_per_batch=64)
    manager = settings.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    rays, batch = manager.next_train(0)
    assert rays.directions.shape == (64, 3)
    dataset = load_dataset(tiny_data)
    camera, row, column = batch["indices"].unbind(-1)
    for k in range(64):
        image = dataset.read_image(dataset.train[int(camera[k])])
        black = composite_bytes(image, (0.0, 0.0, 0.0))
        expected = torch.from_numpy(black[int(row[k]), int(column[k])].astype(np.float32)) / 255
        assert torch.allclose(batch["image"][k], expected, atol=2.1 / 255)
