"""What builds and tries wheels, as far as nothing has to be compiled or loaded."""

import subprocess
import sys
from pathlib import Path

import pytest

from scripts import build_wheels

TRY = Path(__file__).parents[2] / "scripts" / "try_wheel.py"


def interpreter(folder: Path, version: str) -> str:
    """A program that says to be Python of that version."""
    folder.mkdir()
    program = folder / "python3"
    program.write_text(f'#!/bin/sh\necho "{program} {version}"\n')
    program.chmod(0o755)
    return str(program)


def test_interpreters_of_one_file_name_have_environments_of_their_own(tmp_path):
    one, other = interpreter(tmp_path / "one", "3.11"), interpreter(tmp_path / "other", "3.12")
    first = build_wheels.environment_name(one)
    assert first.startswith("python3-")
    assert build_wheels.environment_name(one) == first
    assert build_wheels.environment_name(other) != first
    newer = Path(one)
    newer.write_text(newer.read_text().replace("3.11", "3.12"))
    assert build_wheels.environment_name(one) != first


def test_an_environment_whose_making_was_interrupted_is_made_anew(tmp_path, monkeypatch):
    folder, made = tmp_path / "venv", []

    def run(why: str, *command: object) -> None:
        if "venv" in command:
            assert not folder.exists(), "nothing of the one before is left"
            (folder / "bin").mkdir(parents=True)
            (folder / "bin" / "python").touch()
            made.append(why)
            if len(made) == 1:
                raise KeyboardInterrupt

    monkeypatch.setattr(build_wheels, "run", run)
    with pytest.raises(KeyboardInterrupt):
        build_wheels.new_venv("python3", folder, "pip")
    for _ in range(2):
        build_wheels.new_venv("python3", folder, "pip")
    assert len(made) == 2, "a whole one is kept"


def test_a_python_that_is_not_there_is_told_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(build_wheels, "WORK", tmp_path / "work")
    monkeypatch.setattr(build_wheels.platform, "system", lambda: "Linux")
    monkeypatch.setattr(build_wheels.platform, "machine", lambda: "x86_64")
    with pytest.raises(SystemExit, match="--python nope does not start"):
        build_wheels.main(["--python", sys.executable, "nope"])
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize("content", [None, b"no archive", b"PK\5\6" + bytes(18)])
def test_what_is_no_wheel_is_told(tmp_path, content):
    wheel = tmp_path / "some.whl"
    if content is not None:
        wheel.write_bytes(content)
    ran = subprocess.run([sys.executable, str(TRY), str(wheel)], capture_output=True, text=True)
    assert ran.returncode == 1
    assert "is no wheel with a compiled rasterizer" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_a_wheel_has_to_be_named():
    ran = subprocess.run([sys.executable, str(TRY)], capture_output=True, text=True)
    assert ran.returncode == 2
    assert "wheel" in ran.stderr
