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


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_every_command_has_help(name, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main([name, "--help"])
    assert ended.value.code == 0
    assert f"rgbavatar {name}" in capsys.readouterr().out
