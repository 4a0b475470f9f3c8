import pytest
from rich.errors import MarkupError

from rgbavatar_ns.plugin.console import CONSOLE, say


@pytest.mark.parametrize("folder", ["me [bold] [1]", "[/red]", "x" * 300])
def test_a_path_is_told_whole_whatever_brackets_it_has(
    folder: str, capsys: pytest.CaptureFixture[str]
) -> None:
    say(f"Config: /data/{folder}/config.yml")
    assert capsys.readouterr().out == f"Config: /data/{folder}/config.yml\n"


def test_the_console_itself_would_take_brackets_for_markup(
    capsys: pytest.CaptureFixture[str],
) -> None:
    CONSOLE.print("me [bold]")
    assert capsys.readouterr().out == "me \n"
    with pytest.raises(MarkupError):
        CONSOLE.print("[/red]")
