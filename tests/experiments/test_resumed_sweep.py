"""The command, interrupted in the middle of a cell and called again, ends in the same table."""

import signal
import subprocess
import sys
import time

import pytest

from rgbavatar_ns.cli.main import main
from rgbavatar_ns.experiments import read_experiment
from rgbavatar_ns.experiments.report import write_report
from tests.plugin.tiny import tiny_dataset

pytestmark = pytest.mark.nightly

STEPS = 120
TEXT = f"""
title: Interrupted
preset: rgbavatar-tiny
subjects: [data]
metrics: [psnr, ssim]
base:
  max_num_iterations: {STEPS}
  learning_rate_steps: {STEPS}
  steps_per_save: 1
  pipeline.model.avatar.uv_resolution: 16
variants: [{{name: three bases, set: {{pipeline.model.avatar.num_bases: 3}}}}]
"""


def _checkpoints(out):
    return sorted(out.glob("cells/*/run/**/step-*.ckpt"))


def test_an_interrupted_sweep_ends_in_the_table_of_an_uninterrupted_one(tmp_path):
    tiny_dataset(tmp_path / "data")
    file = tmp_path / "interrupted.yaml"
    file.write_text(TEXT)
    program = "import sys; from rgbavatar_ns.cli.main import main; main(sys.argv[1:])"
    sweep = ["sweep", str(file), "--output"]
    command = [sys.executable, "-c", program, *sweep, str(tmp_path / "resumed")]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        end = time.monotonic() + 300
        while not _checkpoints(tmp_path / "resumed"):
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.02)  # Steps that save take longer: the signal comes long before the last.
        process.send_signal(signal.SIGINT)
        assert process.wait() == 130
    kept = _checkpoints(tmp_path / "resumed")[-1].name
    assert 0 < int(kept.removeprefix("step-").removesuffix(".ckpt")) < STEPS - 1
    for out in ("resumed", "whole"):
        # The same command in this process, which need not load nerfstudio again.
        main([*sweep, str(tmp_path / out)])
    (log,) = (tmp_path / "resumed").glob("cells/*/log.txt")
    assert "Resuming after step" in log.read_text()
    resumed, whole = (
        write_report(read_experiment(file), tmp_path / out, plots=False).table
        for out in ("resumed", "whole")
    )
    assert resumed.to_markdown() == whole.to_markdown()
    assert resumed.rows[0].entries["psnr"].mean == whole.rows[0].entries["psnr"].mean
