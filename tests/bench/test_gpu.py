"""The script that times a GPU, on an emulated one, without what a bare GPU machine lacks."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.kernels.cuda import emulator

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "speed" / "gpu.py"
ABSENT = (
    *("nerfstudio", "tyro", "trimesh", "roma", "cv2", "av", "torchmetrics", "gsplat"),
    "rgbavatar_ns.kernels.cpu._native",
)
EMULATED = """
import runpy, sys
from pathlib import Path
import torch
from tests.kernels.cuda import emulator

class Event:
    def __init__(self, enable_timing): pass
    def record(self): pass
    def elapsed_time(self, end): return 1.0

torch.cuda.Event, torch.cuda.synchronize = Event, lambda: None
script = runpy.run_path(sys.argv[1])
backend = emulator.load()
from rgbavatar_ns.kernels import registry
real = registry._load
registry._load = lambda name: backend if name == "cuda" else real(name)
speed = script["measure_speed"](matrix_side=64, copy_mib=1, seconds=0.001)
script["rasterizer"].__globals__["measure_speed"] = lambda device: speed
work = script["Workload"](
    torch.device("cpu"), 0.001, lambda work: work, 60, 24, 2, 3, uv_resolution=12
)
sys.exit(script["measure"](work, float(sys.argv[3]), Path(sys.argv[2])))
"""


def run(tmp_path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """What runs in a process that finds none of what a bare machine lacks."""
    absent = f"import sys\nsys.modules.update(dict.fromkeys({ABSENT!r}))\n"
    command = [sys.executable, "-c", absent + EMULATED, str(SCRIPT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])


@pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to emulate CUDA with")
def test_every_row_is_printed_and_written(tmp_path):
    path = tmp_path / "figures" / "gpu.json"
    ran = run(tmp_path, str(path), "1000")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    rows = json.loads(path.read_text())["rows"]
    assert list(rows) == ["smoke", "rasterizer", "steps", "kernels", "rendering", "gsplat"]
    assert rows["smoke"]["largest_difference"] < 1e-4
    assert rows["rasterizer"]["both"]["median_ms"] > 0
    assert 0 < rows["rasterizer"]["roofline"]["reached"] < 1
    assert rows["steps"]["recorded_images_per_second"] > 0
    assert {"train_ms", "update_ms"} < set(rows["kernels"])
    assert rows["rendering"]["recorded_frames_per_second_by_2"] > 0
    assert "gsplat" in rows["gsplat"]["left_out"]
    assert all(f"{name}: " in ran.stdout for name in rows)


@pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to emulate CUDA with")
def test_what_the_budget_does_not_allow_is_left_out(tmp_path):
    path = tmp_path / "gpu.json"
    assert run(tmp_path, str(path), "-1").returncode == 0
    rows = json.loads(path.read_text())["rows"]
    assert all("budget" in row["left_out"] for row in rows.values())


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_in_a_sentence():
    ran = subprocess.run([sys.executable, str(SCRIPT)], capture_output=True, text=True)
    assert ran.returncode == 1
    assert ran.stdout.strip() == ""
    assert ran.stderr.strip() == "torch sees no NVIDIA GPU, which is what is to be timed."
