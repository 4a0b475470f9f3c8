"""A user's mistake ends a command with its message; other errors keep their traceback."""

import subprocess
import sys

import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.errors import install_user_error_hook

_PROGRAM = """
from rgbavatar_ns.plugin.errors import install_user_error_hook
install_user_error_hook()
raise ValueError("a defect")
"""


def test_other_errors_keep_their_traceback():
    command = [sys.executable, "-c", _PROGRAM]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "Traceback" in ended.stderr
    assert "a defect" in ended.stderr


def test_installing_twice_tells_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    install_user_error_hook()
    hook = sys.excepthook
    install_user_error_hook()
    assert sys.excepthook is hook
    error = UserError("Cause.", "Remedy.")
    sys.excepthook(UserError, error, None)
    assert capsys.readouterr().err == "\nError: Cause.\nRemedy.\n"
