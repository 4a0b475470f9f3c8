"""How commands print what contains names of users."""

import shlex
from pathlib import Path

from rich.console import Console


def plain_console(*, soft_wrap: bool = True) -> Console:
    """A console that shows texts as they are: [brackets] and :colons: of a path are no markup.

    soft_wrap: long lines are left to the terminal, so that a path can be copied whole.
    """
    return Console(markup=False, emoji=False, highlight=False, soft_wrap=soft_wrap)


def command_line(*words: str | Path) -> str:
    """A command as a shell takes it, also where a path has spaces."""
    return shlex.join(map(str, words))
