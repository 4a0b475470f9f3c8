"""What commands print of users' names."""

import shlex

import pytest

from rgbavatar_ns.cli.console import command_line, plain_console


@pytest.mark.parametrize("name", ["a [bold] head", "[/red]", ":smile: 12:30", "[link=x]a[/link]"])
def test_a_path_is_printed_as_it_is(name, capsys):
    plain_console().print(f"in /films/{name}")
    assert capsys.readouterr().out == f"in /films/{name}\n"


def test_a_long_path_is_not_broken(capsys):
    path = "/films/" + "x" * 300
    plain_console().print(path)
    assert capsys.readouterr().out == f"{path}\n"


def test_a_shell_takes_the_command_line_apart_again(tmp_path):
    words = ["ns-train", "rgbavatar", "--data", tmp_path / "my 'head' [1]"]
    assert shlex.split(command_line(*words)) == [str(word) for word in words]
