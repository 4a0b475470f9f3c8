"""Work that is killed at random moments ends, repeated, as work that was left alone."""

import subprocess
import sys
from pathlib import Path

import pytest

_COMMAND = Path(__file__).parents[2] / "benchmarks" / "quality" / "kills.py"
_KINDS = ("train", "import", "bundle", "sweep")


@pytest.mark.nightly
def test_killed_work_goes_on_as_if_nothing_had_happened():
    words = [sys.executable, str(_COMMAND), "--kills", "8", "--seed", "3", "--only", *_KINDS]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
