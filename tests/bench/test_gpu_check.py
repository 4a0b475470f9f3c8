"""The GPU check's own code, on an emulated GPU and without what a bare GPU machine lacks."""

import importlib.util
import json
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from tests.kernels.cuda import emulator

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "gpu_check.py"
ABSENT = (
    *("nerfstudio", "tyro", "trimesh", "roma", "cv2", "av", "torchmetrics", "hypothesis"),
    "rgbavatar_ns.kernels.cpu._native",
)


@pytest.fixture
def script():
    spec = importlib.util.spec_from_file_location("gpu_check", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def bare_environment(tmp_path, monkeypatch):
    """Python processes find none of what a bare machine lacks, nor our compiled CPU backend."""
    absent = f"import sys\nsys.modules.update(dict.fromkeys({ABSENT!r}))\n"
    (tmp_path / "sitecustomize.py").write_text(absent)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


@pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to emulate CUDA with")
def test_every_question_that_needs_no_gpu_is_answered(script, bare_environment, tmp_path, capsys):
    path = tmp_path / "figures" / "gpu.json"
    assert script.main(["--emulate", "--json", str(path)]) == 0
    figures = json.loads(path.read_text())
    assert tuple(figures["sections"]) == script.EMULATED
    for row in figures["sections"].values():
        assert row["result"] == "ok", row
        assert row["figures"]
    assert figures["machine"]["instruction_set"] is None
    assert figures["machine"]["emulated"] is True
    printed = capsys.readouterr().out
    assert all(name in printed for name in script.EMULATED)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_in_a_sentence():
    ran = subprocess.run([sys.executable, str(SCRIPT)], capture_output=True, text=True)
    assert ran.returncode == 1
    assert ran.stdout.strip() == ""
    assert ran.stderr.strip().endswith("--emulate needs none.")
    assert len(ran.stderr.strip().splitlines()) == 1


def test_a_process_that_a_section_ends_is_started_again_for_the_others(script, tmp_path, capsys):
    """The child writes rows, so a child of ours stands in for it."""
    child = tmp_path / "child.py"
    child.write_text(
        textwrap.dedent(
            """
            import json, os, sys
            names = sys.argv[sys.argv.index("--only") + 1 :]
            rows = open(sys.argv[sys.argv.index("--rows") + 1], "a")
            for name in names:
                if name == "step":
                    rows.write('["step", {"half')
                    rows.flush()
                    os._exit(7)
                row = {"result": "ok", "told": "well", "seconds": 1.0}
                print(json.dumps([name, row]), file=rows, flush=True)
            """
        )
    )
    script.__file__ = str(child)
    assert script.main(["--only", "agreement", "step", "overflow"]) == 1
    printed = capsys.readouterr().out
    assert "the process ended with 7" in printed
    assert printed.count("well") == 2


def test_a_section_that_hangs_is_ended(script, tmp_path, monkeypatch, capsys):
    child = tmp_path / "child.py"
    child.write_text("import time\ntime.sleep(60)\n")
    script.__file__ = str(child)
    monkeypatch.setattr(script, "LIMIT_S", 1)
    assert script.main(["--only", "step"]) == 1
    assert "took longer than 1 s" in capsys.readouterr().out


def test_a_section_that_does_not_exist_is_refused(script, capsys):
    with pytest.raises(SystemExit):
        script.main(["--only", "speed"])
    assert "invalid choice: 'speed'" in capsys.readouterr().err
