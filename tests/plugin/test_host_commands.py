"""nerfstudio's commands that film a run, and those that cannot do anything with this method."""

import json
import os
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.render import (
    DatasetRender,
    RenderCameraPath,
    RenderInterpolated,
    SpiralRender,
)
from PIL import Image

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.host_commands import told_of_command
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline
from tests.export.subject import camera_path
from tests.plugin.run import finished_run, run_command
from tests.plugin.tiny import NUM_TEST

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def config(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run's config.yml."""
    return finished_run(tiny_data, tmp_path_factory.mktemp("run"), max_num_iterations=30)


@pytest.fixture
def ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """nerfstudio asks for ffmpeg, also where it writes single images."""
    program = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    (tmp_path / "ffmpeg").symlink_to(program)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)


@pytest.fixture
def exporter(monkeypatch: pytest.MonkeyPatch) -> Any:
    """nerfstudio's module behind ns-export; nothing before its refusals needs open3d itself."""
    monkeypatch.setitem(sys.modules, "open3d", types.ModuleType("open3d"))
    from nerfstudio.scripts import exporter

    return exporter


def pictures(folder: Path) -> list[np.ndarray]:
    return [np.asarray(Image.open(path)).astype(int) for path in sorted(folder.glob("*.png"))]


def change(first: np.ndarray, second: np.ndarray) -> int:
    return int(np.abs(first - second).max())


@pytest.mark.usefixtures("ffmpeg")
@pytest.mark.parametrize("source", ["eval", "train"])
def test_interpolate_plays_the_performance(
    config: Path, tiny_data: Path, tmp_path: Path, source: str
):
    RenderInterpolated(
        config,
        output_path=tmp_path / "film.mp4",
        output_format="images",
        image_format="png",
        pose_source=source,  # type: ignore[arg-type]
        interpolation_steps=3,
        order_poses=True,
    ).main()
    shown = pictures(tmp_path / "film")
    tracked = load_dataset(tiny_data)
    pairs = len(tracked.test if source == "eval" else tracked.train) - 1
    assert len(shown) == 3 * pairs
    for start in range(0, len(shown), 3):
        before, between, after = shown[start : start + 3]
        # The camera stands still, so that only the face can have moved.
        assert change(before, after) > 3
        assert 0 < change(before, between) <= change(before, after) + 20
    # Where one pair of frames ends the next begins.
    assert all(change(*shown[end : end + 2]) == 0 for end in range(2, len(shown) - 1, 3))


@pytest.mark.usefixtures("ffmpeg")
def test_a_film_of_one_picture_a_frame_shows_the_held_out_frames(config: Path, tmp_path: Path):
    film: dict[str, Any] = {"output_format": "images", "interpolation_steps": 1}
    RenderInterpolated(config, tmp_path / "film.mp4", "png", **film).main()
    DatasetRender(config, tmp_path / "frames", "png", rendered_output_names=["rgb"]).main()
    shown, frames = pictures(tmp_path / "film"), pictures(tmp_path / "frames" / "test" / "rgb")
    assert (len(shown), len(frames)) == (NUM_TEST - 1, NUM_TEST)
    assert all(change(*pair) <= 1 for pair in zip(shown, frames))


def _path_file(folder: Path, **more: Any) -> Path:
    # The camera looks at the face along +y, z up.
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -0.9], [0, 1, 0, 0], [0, 0, 0, 1]])
    described = camera_path(pose.expand(3, 4, 4), fps=3, seconds=1)
    path = folder / "path.json"
    path.write_text(json.dumps({**described, **more}))
    return path


@pytest.mark.usefixtures("ffmpeg")
def test_a_camera_path_without_times_plays_frame_by_frame(config: Path, tmp_path: Path):
    arguments: dict[str, Any] = {
        "camera_path_filename": _path_file(tmp_path),
        "output_format": "images",
        "image_format": "png",
    }
    RenderCameraPath(config, tmp_path / "film.mp4", **arguments).main()
    first, second, third = pictures(tmp_path / "film")
    assert change(first, second) > 10
    assert change(second, third) > 10
    RenderCameraPath(config, tmp_path / "held.mp4", camera_idx=1, **arguments).main()
    held = pictures(tmp_path / "held")
    assert all(change(held[0], picture) == 0 for picture in held)
    assert change(held[0], second) == 0


@pytest.mark.usefixtures("ffmpeg")
def test_a_crop_box_is_refused(config: Path, tmp_path: Path):
    black = {"r": 0, "g": 0, "b": 0}
    crop = {"crop_bg_color": black, "crop_center": [0, 0, 0], "crop_scale": [1, 1, 1]}
    path = _path_file(tmp_path, crop=crop)
    with pytest.raises(UserError, match=r"crop box.*Crop Viewport"):
        RenderCameraPath(config, tmp_path / "film.mp4", camera_path_filename=path).main()


def told(work: Callable[[], object], kind: type[Exception]) -> str:
    """How the command tells what its `main` raises."""
    with pytest.raises(kind) as raised:
        work()
    error = told_of_command(raised.value, raised.tb) or raised.value
    assert isinstance(error, UserError)
    return str(error)


@pytest.mark.usefixtures("ffmpeg")
def test_what_ns_render_cannot_do_is_told(config: Path, tmp_path: Path):
    out = tmp_path / "film.mp4"
    spiral = told(SpiralRender(config, out).main, AssertionError)
    assert "rgbavatar render RUN OUT --show turntable" in spiral
    no_steps = told(RenderInterpolated(config, out, interpolation_steps=0).main, ValueError)
    assert "--interpolation-steps is 0" in no_steps
    smaller = told(DatasetRender(config, out, downscale_factor=2.0).main, UserError)
    assert "--downscale-factor is 2" in smaller
    rays = told(RenderInterpolated(config, out, render_nearest_camera=True).main, UserError)
    assert "--render-nearest-camera" in rays


@pytest.mark.parametrize("name", ["scores.txt", "scores", ".json"])
def test_scores_in_a_file_of_another_ending_are_refused_before_they_are_counted(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
):
    counted: list[object] = []
    monkeypatch.setattr(RGBAvatarPipeline, "get_average_eval_image_metrics", counted.append)
    scores = told(ComputePSNR(config, tmp_path / name).main, AssertionError)
    assert f"--output-path is {tmp_path / name}" in scores
    assert "ends in .json" in scores
    assert not counted
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("kind", "options", "raised"),
    [
        ("ExportGaussianSplat", {}, AssertionError),
        ("ExportMarchingCubesMesh", {}, AssertionError),
        ("ExportPointCloud", {"normal_method": "open3d"}, AssertionError),
        ("ExportPointCloud", {}, UserError),
        ("ExportPoissonMesh", {}, UserError),
        ("ExportTSDFMesh", {}, UserError),
    ],
)
def test_ns_export_names_the_command_that_exports(
    config: Path,
    tmp_path: Path,
    exporter: Any,
    kind: str,
    options: dict[str, str],
    raised: type[Exception],
):
    export = getattr(exporter, kind)(config, tmp_path / "export", **options)
    assert "rgbavatar export RUN DST --format ply" in told(export.main, raised)


def test_ns_export_writes_the_cameras(config: Path, tmp_path: Path, exporter: Any):
    exporter.ExportCameraPoses(config, tmp_path / "export").main()
    for split, count in (("train", None), ("eval", NUM_TEST)):
        frames = json.loads((tmp_path / "export" / f"transforms_{split}.json").read_text())
        assert frames
        assert count in (None, len(frames))


@pytest.mark.parametrize(
    ("command", "instead"),
    [
        (("ns-export", "gaussian-splat", "--output-dir"), "rgbavatar export RUN DST --format ply"),
        pytest.param(
            ("ns-render", "spiral", "--output-path"),
            "rgbavatar render RUN OUT --show turntable",
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_a_refusal_ends_without_a_traceback(
    config: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: tuple[str, ...],
    instead: str,
):
    (tmp_path / "open3d.py").write_text("")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    ended = run_command(*command, tmp_path / "out", "--load-config", config)
    assert ended.returncode == 1
    assert instead in ended.stderr
    assert "Traceback" not in ended.stdout + ended.stderr


def test_assertions_elsewhere_stay_what_they_are():
    with pytest.raises(AssertionError) as raised:
        raise AssertionError("a defect")
    assert told_of_command(raised.value, raised.tb) is None
