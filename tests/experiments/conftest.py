import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import tests.nerfstudio_loaded  # noqa: F401  first of all: see there
from rgbavatar_ns.experiments import engines, read_experiment
from rgbavatar_ns.experiments.spec import Experiment

FAKE_RUNNER = """
import json, os, pathlib, resource, signal, sys, time
folder = pathlib.Path(sys.argv[1])
cell = json.loads((folder / "cell.json").read_text())
with (folder / "calls.txt").open("a") as calls:
    calls.write("x")
print("training", cell["variant"], flush=True)
if cell["variant"] == "broken":
    BREAK
if cell["variant"] == "shaky" and (folder / "calls.txt").read_text() == "x":
    sys.exit("once only")
psnr = 30 + cell["overrides"]["pipeline.model.avatar.num_bases"] / 10 + cell["seed"]
result = {"metrics": {"psnr": psnr, "ssim": 0.9}, "unavailable": {"lpips_vgg": "no weights"}}
(folder / "result.json").write_text(json.dumps(result))
"""
TEXT = """
title: Bases & more
preset: rgbavatar-tiny
paper_data: INSTA
subjects: [{subjects}]
seeds: [{seeds}]
variants:
{variants}
"""


@pytest.fixture
def experiment_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Experiment]:
    """Reads an experiment of the named variants, of 10, 20, ... bases, which trains nothing.

    "broken" runs the line `break_`, and "shaky" fails the first time.
    """
    runner = tmp_path / "fake_runner.py"
    monkeypatch.setattr(engines, "_RUNNER", (sys.executable, str(runner)))
    (tmp_path / "data").mkdir()

    def build(
        *names: str,
        break_: str = "sys.exit('CUDA out of memory, so to speak')",
        subjects: str = "data",
        seeds: str = "0, 2",
        paper: str = "",
    ) -> Experiment:
        runner.write_text(FAKE_RUNNER.replace("BREAK", break_))
        rows = [
            f"  - name: {name}\n    set: {{pipeline.model.avatar.num_bases: {count}}}\n{paper}"
            for name, count in zip(names, range(10, 100, 10))
        ]
        path = tmp_path / "bases.yaml"
        path.write_text(TEXT.format(subjects=subjects, seeds=seeds, variants="".join(rows)))
        return read_experiment(path)

    return build
