import json
import subprocess
import sys
from pathlib import Path

import av
import cv2
import pytest

from rgbavatar_ns.cli.main import main

RGBAVATAR = Path(sys.executable).with_name("rgbavatar")
OPTIONS = ["--frames", "12", "--image-size", "48", "--steps", "12"]


def demo(output: Path) -> subprocess.CompletedProcess[str]:
    command = [str(RGBAVATAR), "demo", "--output", str(output), *OPTIONS]
    return subprocess.run(command, capture_output=True, text=True, timeout=800)


@pytest.mark.slow
def test_demo_goes_from_nothing_to_a_film_and_the_second_time_only_tells(tmp_path, capsys):
    first = demo(tmp_path)
    assert first.returncode == 0, first.stdout + first.stderr
    summary = json.loads((tmp_path / "summary.json").read_text())
    for name in ("psnr", "ssim", "train_seconds", "images_per_second", "total_seconds"):
        assert summary[name] > 0, name
    assert summary["held_out_frames"] == 3
    assert summary["total_seconds"] >= summary["train_seconds"]
    with av.open(summary["video"]) as film:
        frames = [frame for frame in film.decode(video=0)]
    assert [(f.width, f.height) for f in frames] == [(3 * 48, 48)] * 3
    assert cv2.imread(summary["picture"]).shape[0] == 3 * 48
    assert "ns-viewer" in first.stdout
    assert str(summary["picture"]) in first.stdout.replace("\n", "")

    capsys.readouterr()
    main(["demo", "--output", str(tmp_path), *OPTIONS])
    assert capsys.readouterr().out.count("done before") == 4
    again = json.loads((tmp_path / "summary.json").read_text())
    assert again["psnr"] == summary["psnr"]
    assert again["total_seconds"] < summary["total_seconds"]
