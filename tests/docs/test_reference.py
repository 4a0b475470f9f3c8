"""The pages that are read from the code: whole, true, and as the code is now."""

import re
from pathlib import Path

import pytest

from rgbavatar_ns.cli.main import COMMANDS
from scripts import error_texts, write_reference

ROOT = Path(__file__).parents[2]
MOST_UNTOLD = 0.02
"""Share of places whose error only passes on what another made: nothing of its words is there."""
_QUOTED = re.compile(r'^\| "(.*?)" \|', flags=re.M)


@pytest.fixture(scope="module")
def texts() -> list[error_texts.ErrorText]:
    return error_texts.error_texts(ROOT / "rgbavatar_ns")


def test_what_an_error_says_is_read_with_gaps(tmp_path: Path) -> None:
    (tmp_path / "it.py").write_text(
        '_AGAIN = "Try again."\n'
        "def a(path):\n"
        '    why = f"it has {path}"\n'
        '    raise UserError(f"There is no {path}: {why}.", _AGAIN)\n'
        "def b(error):\n"
        "    raise UserError(error.cause, error.remedy)\n"
        "def c():\n"
        '    raise DamagedFileError("it is " "cut off")\n'
    )
    told, reason = error_texts.error_texts(tmp_path)
    assert (told.cause, told.remedy, told.line) == ("There is no …: it has ….", "Try again.", 4)
    assert (reason.kind, reason.cause) == ("reason", "it is cut off")


def test_nearly_every_place_that_raises_a_users_error_is_on_the_page(
    texts: list[error_texts.ErrorText],
) -> None:
    """Counted by the words of the sources, not by their syntax."""
    raising = re.compile(
        r"(?<!class )\b(?:(?:User|Disk|FlameVersion|Device)Error|Problem)\(\s*[^\s)]"
    )
    places = sum(
        len(raising.findall(path.read_text())) for path in (ROOT / "rgbavatar_ns").rglob("*.py")
    )
    told = [text for text in texts if text.kind == "told"]
    assert places > 300
    assert len(told) >= (1 - MOST_UNTOLD) * places
    page = write_reference.ERRORS_PAGE.read_text()
    missing = [text for text in told if write_reference.cell(text.cause) not in page]
    assert not missing, "make reference"


def test_the_page_of_errors_is_what_the_sources_say() -> None:
    assert write_reference.ERRORS_PAGE.read_text() == write_reference.errors_page(), (
        "make reference"
    )


@pytest.mark.slow
def test_the_page_of_commands_is_what_the_parsers_say() -> None:
    """The parsers of all methods take seconds."""
    page = write_reference.commands_page()
    assert write_reference.COMMANDS_PAGE.read_text() == page, "make reference"
    for command in COMMANDS:
        assert f"### rgbavatar {command}\n" in page
    assert "| `--pipeline.model.avatar.num-bases INT` | 20 |" in page


def test_each_argument_of_a_command_has_a_row() -> None:
    page = write_reference.COMMANDS_PAGE.read_text()
    taken = {"import": ("SRC", "DST"), "render": ("RUN", "OUTPUT"), "export": ("RUN", "DST")}
    for command, arguments in taken.items():
        told = page.split(f"### rgbavatar {command}\n")[1].split("\n### ")[0]
        assert f"`rgbavatar {command} {' '.join(arguments)}`" in told
        for argument in arguments:
            assert f"| `{argument}` |" in told, command


def test_what_troubleshooting_quotes_is_said_somewhere(texts: list[error_texts.ErrorText]) -> None:
    quotes = _QUOTED.findall((ROOT / "docs" / "troubleshooting.md").read_text())
    assert len(quotes) > 40
    for quote in quotes:
        assert any(quote in text.cause for text in texts), quote
