"""nerfstudio's own commands: typed by a user, or called here where starting them is slow."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.render import DatasetRender, RenderCameraPath
from PIL import Image

from tests.export.subject import camera_path
from tests.plugin.run import finished_run, run_command
from tests.plugin.tiny import NUM_TEST, SIZE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def config(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run's config.yml."""
    folder = tmp_path_factory.mktemp("run")
    return finished_run(tiny_data, folder, max_num_iterations=5, lpips_metric=True)


def test_train_takes_its_flags_in_any_order(tiny_data: Path, tmp_path: Path):
    flags = "--pipeline.model.avatar.uv-resolution 16 --vis tensorboard --max-num-iterations 6"
    more = "--pipeline.model.avatar.num-bases 2 --pipeline.datamanager.batch-size 3 --timestamp run"
    trained = run_command(
        *("ns-train", "rgbavatar-tiny", *flags.split()),
        *("--pipeline.datamanager.dataparser.data", tiny_data, *more.split()),
        *("--data", tiny_data, "--output-dir", tmp_path),
        *("--optimizers.color.optimizer.lr", "0.01"),
    )
    assert trained.returncode == 0, trained.stdout + trained.stderr
    run_folder = tmp_path / "data" / "rgbavatar-tiny" / "run"
    assert json.loads((run_folder / "training.json").read_text())["steps"] == 6


def test_eval_writes_metrics_without_network(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # No address can be reached through this proxy: as on a machine without network.
    for name in ("http_proxy", "https_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    scores = tmp_path / "scores.json"
    ComputePSNR(config, scores, render_output_path=tmp_path / "pictures").main()
    results = json.loads(scores.read_text())["results"]
    assert results["psnr"] > 5
    assert -1 <= results["ssim"] <= 1
    assert "lpips_vgg" in results or "LPIPS" in results["lpips_unavailable"]
    pictures = sorted((tmp_path / "pictures").glob("*.png"))
    assert len(pictures) == NUM_TEST
    # Truth, avatar and error side by side.
    assert Image.open(pictures[0]).size == (3 * SIZE, SIZE)


def test_a_users_mistake_is_told_without_a_traceback(tmp_path: Path):
    ended = run_command(
        "ns-train", "rgbavatar-tiny", "--data", tmp_path / "absent", "--output-dir", tmp_path
    )
    assert ended.returncode == 1
    assert "Error: " in ended.stderr
    assert "absent" in ended.stderr
    told = ended.stdout + ended.stderr
    assert "Traceback" not in told
    assert "rgbavatar_ns/" not in told


def test_render_dataset(config: Path, tmp_path: Path):
    names = ["rgb", "gt-rgb", "depth", "rgba"]
    DatasetRender(
        config,
        output_path=tmp_path / "frames",
        rendered_output_names=names,
        image_format="png",
    ).main()
    for name in names:
        images = sorted((tmp_path / "frames" / "test" / name).glob("*.png"))
        assert len(images) == NUM_TEST
        assert Image.open(images[0]).size == (SIZE, SIZE)


def test_render_camera_path_plays_the_performance(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # nerfstudio asks for ffmpeg, also where it writes single images.
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    (tmp_path / "ffmpeg").symlink_to(ffmpeg)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    # The camera looks at the face along +y, z up.
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -0.9], [0, 1, 0, 0], [0, 0, 0, 1]])
    described = camera_path(pose.expand(3, 4, 4), fps=3, seconds=1)
    for frame, time in zip(described["camera_path"], (0.0, 0.5, 1.0)):
        frame["render_time"] = time
    path = tmp_path / "path.json"
    path.write_text(json.dumps(described))
    RenderCameraPath(
        config,
        output_path=tmp_path / "film.mp4",
        image_format="png",
        camera_path_filename=path,
        output_format="images",
    ).main()
    images = [np.asarray(Image.open(p)).astype(int) for p in sorted((tmp_path / "film").iterdir())]
    assert [image.shape for image in images] == [(48, 64, 3)] * 3
    # One camera, three frames of the performance.
    assert all(image.max() > 30 for image in images)
    assert np.abs(images[0] - images[1]).max() > 10
