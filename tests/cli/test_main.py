import os
import subprocess
import sys

import pytest

from rgbavatar_ns.cli import main as cli


def test_help_lists_every_command(capsys):
    cli.main(["--help"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in cli.COMMANDS)


def test_an_unknown_command_ends_with_2_and_the_list(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["tarck"])
    assert ended.value.code == 2
    assert "tarck" in capsys.readouterr().err


def test_a_users_mistake_is_told_in_one_line_without_a_traceback(refused, tmp_path):
    told = refused("demo", "--output", tmp_path, "--video", tmp_path / "none.mp4")
    assert "none.mp4" in told
    assert len(told.strip().splitlines()) == 1


@pytest.mark.parametrize("buffered", [True, False])
@pytest.mark.parametrize(("words", "code"), [(["--help"], 0), (["render", "--help"], 141)])
def test_who_reads_the_output_may_leave(words, code, buffered):
    program = f"from rgbavatar_ns.cli.main import main; main({words})"
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    reader, writer = os.pipe()
    os.close(reader)
    started = [sys.executable, *["-u"] * (not buffered), "-c", program]
    ended = subprocess.run(started, stdout=writer, stderr=subprocess.PIPE, env=env, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (code, b"")


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_every_command_has_help(name, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main([name, "--help"])
    assert ended.value.code == 0
    assert f"rgbavatar {name}" in capsys.readouterr().out
