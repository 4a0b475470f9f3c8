"""Processes of cells: all are interrupted at once, and those that do not end are killed."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from rgbavatar_ns.experiments import engines

_SAVING = """
import pathlib, signal, sys, time
def note(*_):
    pathlib.Path(sys.argv[1]).write_text(str(time.time()))
    time.sleep(float(sys.argv[2]))
    sys.exit(130)
signal.signal(signal.SIGINT, note)
print("ready", flush=True)
time.sleep(300)
"""


def _started(noted: Path, seconds: float) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-c", _SAVING, str(noted), str(seconds)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


def test_cells_save_side_by_side(tmp_path: Path):
    noted = [tmp_path / name for name in ("first", "second", "third")]
    cells = [_started(path, 1.5) for path in noted]
    engines.end_cells(cells)
    assert [cell.poll() for cell in cells] == [130] * 3
    times = [float(path.read_text()) for path in noted]
    assert max(times) - min(times) < 1.4


def test_a_cell_that_does_not_end_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(engines, "_SECONDS_TO_SAVE", 0.5)
    quick, slow = _started(tmp_path / "quick", 0.0), _started(tmp_path / "slow", 200.0)
    began_s = time.monotonic()
    engines.end_cells([slow, quick])
    assert (quick.poll(), slow.poll()) == (130, -9)
    assert time.monotonic() - began_s < 5
