"""What every method asks of a device that is not the processor's: other_device_cases.py."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.kernels.cuda import emulator

_CASES = Path(__file__).with_name("other_device_cases.py")
_MOST_SECONDS = 1200


@pytest.mark.nightly
@pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to make a device with")
def test_everything_lies_where_it_is_asked_for():
    """In a process of its own: torch must know the device before the first backward pass."""
    command = [sys.executable, "-m", "pytest", "-n", "0", "-q", "-p", "no:cacheprovider", _CASES]
    ran = subprocess.run(
        command, capture_output=True, text=True, timeout=_MOST_SECONDS, check=False
    )
    assert ran.returncode == 0, ran.stdout[-8000:]
    assert " passed" in ran.stdout
