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
    monkeypatch.setattr(commands.sys, "executable", str(tmp_path / "python"))
    with pytest.raises(error, match=told):
        commands.run_nerfstudio("ns-train")


def test_what_a_command_did_not_write_is_told_with_its_place(tmp_path, monkeypatch):
    monkeypatch.setattr(commands, "run_nerfstudio", lambda *command: None)
    run_folder = tmp_path / "experiment" / "method" / "run"
    with pytest.raises(UserError, match=r"method/run/training\.json cannot be read: it does not"):
        commands.train("method", tmp_path, run_folder, 0)
    (tmp_path / "eval.json").write_text("{")
    with pytest.raises(UserError, match=r"eval\.json cannot be read: .*the same command again"):
        commands.evaluate(run_folder, tmp_path / "eval.json")
