"""The example that needs no nerfstudio: a dataset in, an avatar, its score and its picture out."""

import json
import re
import runpy
import sys
from pathlib import Path

import cv2
import pytest

from rgbavatar_ns import Avatar
from tests.plugin.tiny import NUM_TEST, SIZE, tiny_dataset

SCRIPT = Path(__file__).parents[2] / "examples" / "train_avatar.py"


def test_it_trains_scores_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    tiny_dataset(tmp_path / "data")
    folders, scores = [str(tmp_path / "data"), str(tmp_path / "out")], {}
    for steps in ("1", "60"):
        arguments = [*folders, "--steps", steps, "--uv-resolution", "16"]
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments])
        runpy.run_path(str(SCRIPT), run_name="__main__")
        told = capsys.readouterr().out
        score, frames = re.findall(r"held-out PSNR ([\d.]+) dB over (\d+) frames", told)[0]
        scores[steps] = float(score)
    assert scores["60"] > scores["1"] + 2
    assert int(frames) == NUM_TEST
    avatar = Avatar.load(tmp_path / "out" / "trained.avatar")
    assert avatar.num_gaussians > 50
    assert avatar.training_statistics is not None, "driving asks for them"
    picture = cv2.imread(str(tmp_path / "out" / "held_out.png"))
    assert picture.shape[0] == 3 * SIZE
    assert len(SCRIPT.read_text().splitlines()) <= 80


def test_without_held_out_frames_the_avatar_is_kept_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    tiny_dataset(tmp_path / "data")
    index = tmp_path / "data" / "dataset.json"
    index.write_text(json.dumps(json.loads(index.read_text()) | {"test_frames": 0}))
    arguments = [str(tmp_path / "data"), str(tmp_path / "out"), "--steps", "1"]
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments, "--uv-resolution", "16"])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    assert Avatar.load(tmp_path / "out" / "trained.avatar").num_gaussians > 50


@pytest.mark.parametrize(
    ("data", "out", "more", "told"),
    [
        ("data", "out", ("--batch-size", "0"), "--batch-size"),
        ("nowhere", "out", (), "nowhere"),
        ("data", "a_file", (), "a_file"),
        ("data", "out", ("--uv-resolution", "0"), "uv-resolution"),
    ],
)
def test_mistakes_are_told_before_anything_is_trained(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    data: str,
    out: str,
    more: tuple[str, ...],
    told: str,
):
    tiny_dataset(tmp_path / "data")
    (tmp_path / "a_file").touch()
    words = [str(SCRIPT), str(tmp_path / data), str(tmp_path / out), *more]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert ended.value.code in (1, 2)
    printed = capsys.readouterr()
    assert told in printed.err
    assert "Steps are" not in printed.out


def test_it_needs_no_nerfstudio():
    assert "nerfstudio" not in SCRIPT.read_text().split('"""', 2)[2]
