"""`make setup` does once what is to be done, and does it again where the environment went."""

import json
from pathlib import Path

import pytest

from scripts import setup_env

WANTED = {"packages": "one", "project": "two"}


@pytest.fixture
def steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is done to a project of its own, where nothing is installed."""
    venv, done = tmp_path / ".venv", []
    for name, path in (
        ("ROOT", tmp_path),
        ("VENV", venv),
        ("PYTHON", venv / "bin" / "python"),
        ("STAMP", venv / "stamp.json"),
    ):
        monkeypatch.setattr(setup_env, name, path)

    def must(why: str, *command: object) -> None:
        done.append(why)
        if command[-1] == venv:
            environment(venv, "3.11")

    monkeypatch.setattr(setup_env, "must", must)
    for name in ("install_torch", "install_torchvision", "link_ffmpeg", "first_imports"):
        monkeypatch.setattr(setup_env, name, lambda name=name: done.append(name))
    hashes = {"requirements/*.txt": "one", "CMakeLists.txt": "two"}
    monkeypatch.setattr(setup_env, "digest", lambda *patterns: hashes[patterns[1]])
    monkeypatch.setattr(setup_env, "module_names", lambda: "")
    monkeypatch.setattr(setup_env, "has_nvidia_gpu", lambda: False)
    monkeypatch.setattr(setup_env.shutil, "which", lambda name: name)
    monkeypatch.delenv("PYTHON", raising=False)
    monkeypatch.chdir(tmp_path)
    return done


def environment(venv: Path, version: str) -> None:
    """A folder that passes for an environment, whose interpreter says yes to everything."""
    (venv / "bin").mkdir(parents=True)
    python = venv / "bin" / "python"
    python.write_text("#!/bin/sh\n")
    python.chmod(0o755)
    (venv / "pyvenv.cfg").write_text(f"home = /usr/bin\nversion = {version}.2\n")


def test_a_second_call_does_nothing(steps):
    setup_env.main()
    assert steps[0] == "making the virtual environment .venv"
    assert steps[-1] == "first_imports"
    assert json.loads(setup_env.STAMP.read_text()) == WANTED
    steps.clear()
    setup_env.main()
    assert steps == []


def test_an_environment_whose_interpreter_went_is_made_anew_with_all_packages(steps):
    setup_env.main()
    every_step = list(steps)
    steps.clear()
    setup_env.PYTHON.unlink()
    setup_env.PYTHON.symlink_to("/gone/python3.9")
    setup_env.main()
    assert steps == every_step
    assert json.loads(setup_env.STAMP.read_text()) == WANTED


def test_a_program_that_is_not_there_is_a_step_that_failed(capsys):
    assert not setup_env.run("/gone/python3.9", "--version")
    assert "/gone/python3.9" in capsys.readouterr().out


def test_an_environment_that_is_not_what_a_new_one_would_be_is_told(steps, monkeypatch, capsys):
    setup_env.main()
    monkeypatch.setattr(setup_env.sys, "version_info", (3, 11, 4, "final", 0))
    monkeypatch.setenv("PYTHON", "/usr/bin/python3.11")
    capsys.readouterr()
    setup_env.main()
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(setup_env.sys, "version_info", (3, 12, 1, "final", 0))
    setup_env.main()
    told = capsys.readouterr().out
    assert "Python 3.11, not of 3.12" in told
    assert "rm -rf .venv && make setup" in told
    monkeypatch.delenv("PYTHON")
    packages = setup_env.VENV / "lib" / "python3.11" / "site-packages"
    (packages / "torch-2.13.0+cpu.dist-info").mkdir(parents=True)
    setup_env.main()
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(setup_env, "has_nvidia_gpu", lambda: True)
    setup_env.main()
    assert "torch stays the CPU build" in capsys.readouterr().out


def test_a_driver_that_torch_cannot_use_is_told(monkeypatch, capsys):
    ran = []
    monkeypatch.setattr(setup_env, "installed_torch", lambda: "")
    monkeypatch.setattr(setup_env, "must", lambda *command: ran.append(command))
    monkeypatch.setattr(setup_env, "has_nvidia_gpu", lambda: True)
    for sees in (True, False):
        monkeypatch.setattr(setup_env, "run", lambda *command, quiet, sees=sees: sees)
        setup_env.install_torch()
        assert ("older than torch's CUDA" in capsys.readouterr().out) is not sees
    assert len(ran) == 2


@pytest.mark.parametrize(
    ("named", "installed", "found"),
    [
        (None, ["g++"], True),
        (None, ["clang++"], True),
        (None, [], False),
        ("", [], False),
        (" ", ["/opt/gcc/bin/g++-12"], False),
        ("/opt/gcc/bin/g++-12 -m64", ["/opt/gcc/bin/g++-12"], True),
        ("/opt/gcc/bin/g++-12", [], False),
    ],
)
def test_a_compiler_is_the_one_that_is_named_or_a_usual_one(
    steps, monkeypatch, named, installed, found
):
    monkeypatch.delenv("CXX", raising=False)
    if named is not None:
        monkeypatch.setenv("CXX", named)
    monkeypatch.setattr(setup_env.shutil, "which", lambda name: name in installed or None)
    if found:
        setup_env.main()
        assert json.loads(setup_env.STAMP.read_text()) == WANTED
    else:
        with pytest.raises(SystemExit, match=r"no C\+\+ compiler found.*CXX="):
            setup_env.main()


def test_bytecode_is_no_source(tmp_path, monkeypatch):
    monkeypatch.setattr(setup_env, "ROOT", tmp_path)
    source = tmp_path / "kernels" / "draw.cpp"
    source.parent.mkdir()
    source.write_text("int one;")
    first = setup_env.digest("kernels/**/*.[ch]*")
    bytecode = tmp_path / "kernels" / "__pycache__" / "backend.cpython-311.pyc"
    bytecode.parent.mkdir()
    bytecode.write_bytes(b"any")
    assert setup_env.digest("kernels/**/*.[ch]*") == first
    source.write_text("int two;")
    assert setup_env.digest("kernels/**/*.[ch]*") != first
