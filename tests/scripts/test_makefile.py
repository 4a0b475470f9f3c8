"""Targets of the Makefile that run more than one command."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]
NO_TESTS_PASS = """#!/bin/sh
case "$*" in
  *pytest*"nightly and not browser") echo the first half; exit 1;;
  *pytest*"nightly and browser") echo the browsers half;;
esac
"""


def test_tests_of_the_night_that_fail_leave_the_browser_its_own(tmp_path):
    python = tmp_path / "python"
    python.write_text(NO_TESTS_PASS)
    python.chmod(0o755)
    command = ["make", "test-nightly", "PYTHON=true", f"BIN={tmp_path}"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert "the first half" in ran.stdout
    assert "the browsers half" in ran.stdout
    assert ran.returncode != 0, "the first half's failure stays one"
