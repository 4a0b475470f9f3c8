"""nerfstudio's commands as child processes: how each way to end is told."""

import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments import commands


@pytest.mark.parametrize(
    ("ending", "error", "told"),
    [
        ("exit 3", UserError, "exit code 3"),
        ("kill -KILL $$", UserError, "ns-train was killed by SIGKILL, probably out of memory"),
        ("exit 130", KeyboardInterrupt, None),
    ],
)
def test_each_end_is_told(tmp_path, monkeypatch, ending, error, told):
    program = tmp_path / "ns-train"
    program.write_text(f"#!/bin/sh\n{ending}\n")
    program.chmod(0o755)
    monkeypatch.setattr(commands.sysconfig, "get_path", lambda *_: str(tmp_path))
    with pytest.raises(error, match=told):
        commands.run_nerfstudio("ns-train")


def test_a_program_is_found_where_this_environment_has_it(tmp_path, monkeypatch):
    """From the first place to the last: its scripts, the user's, beside the interpreter, PATH."""
    folders = [tmp_path / name for name in ("scripts", "user", "interpreter", "path")]
    for folder in folders:
        folder.mkdir()
        (folder / "ns-train").touch()
        (folder / "ns-train").chmod(0o755)
    scripts, user, interpreter, path = folders
    monkeypatch.setattr(
        commands.sysconfig, "get_path", lambda name, scheme="": str(user if scheme else scripts)
    )
    monkeypatch.setattr(commands.site, "ENABLE_USER_SITE", True)
    monkeypatch.setattr(commands.sys, "executable", str(interpreter / "python"))
    monkeypatch.setenv("PATH", str(path))
    for folder in folders:
        assert commands.require_program("ns-train") == folder / "ns-train"
        (folder / "ns-train").unlink()
    assert commands.find_program("ns-train") is None
    monkeypatch.setattr(commands.sys, "prefix", "/opt/env")
    with pytest.raises(UserError, match="There is no ns-train in the environment /opt/env"):
        commands.run_nerfstudio("ns-train")


def test_what_a_command_did_not_write_is_told_with_its_place(tmp_path, monkeypatch):
    monkeypatch.setattr(commands, "run_nerfstudio", lambda *command: None)
    run_folder = tmp_path / "experiment" / "method" / "run"
    with pytest.raises(UserError, match=r"method/run/training\.json cannot be read: it does not"):
        commands.train("method", tmp_path, run_folder, 0)
    (tmp_path / "eval.json").write_text("{")
    with pytest.raises(UserError, match=r"eval\.json cannot be read: .*the same command again"):
        commands.evaluate(run_folder, tmp_path / "eval.json")
