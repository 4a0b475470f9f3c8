"""The commands and their options as Markdown tables, read from the parsers that run them."""

import importlib
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import entry_points
from typing import Any

import tyro

from rgbavatar_ns.cli.main import COMMANDS, module_name

_DEFAULT = re.compile(r"\s*\((?:default|fixed to): (.*)\)$", flags=re.S)
_OF_THE_MACHINE = {"--machine.device-type": "cuda where it can be used, else cpu"}
Row = tuple[str, str, str]
"""Option with what it takes, default, meaning."""


def command_pages() -> Iterator[str]:
    """A section for each command of `rgbavatar`."""
    for name in COMMANDS:
        run = importlib.import_module(f"rgbavatar_ns.cli.{module_name(name)}").run
        yield f"### rgbavatar {name}"
        yield from _sections(_parser(run), f"rgbavatar {name}")


def method_pages() -> Iterator[str]:
    """The methods of `ns-train`, the options of `rgbavatar`, and what others have besides."""
    methods = {name: spec.config for name, spec in _methods()}
    yield _table(
        ("method", "what it is"),
        [(f"`{name}`", spec.description) for name, spec in _methods()],
    )
    rows = {name: _rows(_parser(type(config), config)) for name, config in methods.items()}
    first = rows["rgbavatar"]
    yield "### Options of ns-train rgbavatar"
    yield from _by_part(first.values())
    for name, own in rows.items():
        if name == "rgbavatar":
            continue
        like = (
            "rgbavatar-online" if "online" in name and name != "rgbavatar-online" else "rgbavatar"
        )
        others = [row for option, row in own.items() if row[:2] != rows[like].get(option, ())[:2]]
        yield f"### Where ns-train {name} differs from {like}"
        yield _table(("option", "default", "what it is"), others)


def _methods() -> list[tuple[str, Any]]:
    group = entry_points(group="nerfstudio.method_configs")
    own = [point for point in group if point.value.startswith("rgbavatar_ns.")]
    order = sorted(own, key=lambda point: (not point.name.startswith("rgbavatar"), point.name))
    return [(point.name, point.load()) for point in order]


def _parser(run: Callable[..., Any] | type, default: Any = None) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # there is no other way to the parser
        return (
            tyro.extras.get_parser(run)
            if default is None
            else tyro.extras.get_parser(run, default=default)
        )


def _sections(parser: Any, name: str) -> Iterator[str]:
    """Description and table of a command, then those of its sub-commands."""
    actions = parser._actions
    positional = [a for a in actions if not a.option_strings and not _choices(a)]
    takes = " ".join(str(action.metavar) for action in positional)
    yield f"`{name} {takes}`".replace(" `", "`")
    yield _plain(parser.description or "")
    rows = list(_rows(parser).values())
    if rows:
        yield _table(("option", "default", "what it is"), rows)
    for action in actions:
        for choice, below in _choices(action).items():
            yield from _sections(below, f"{name} {choice}")


def _choices(action: Any) -> dict[str, Any]:
    return action.choices if isinstance(action.choices, dict) else {}


def _rows(parser: Any) -> dict[str, Row]:
    rows: dict[str, Row] = {}
    for action in parser._actions:
        if _choices(action) or action.dest == "help" or str(action.metavar) == "{fixed}":
            continue
        told = str(action.help or "")
        found = _DEFAULT.search(told)
        name = action.option_strings[0] if action.option_strings else str(action.metavar)
        takes = f" {action.metavar}" if action.option_strings and action.metavar else ""
        default = _OF_THE_MACHINE.get(name, found[1] if found else "")
        code = f"`{name}{takes}`".replace("|", "\\|")
        rows[name if action.option_strings else action.dest] = (
            code,
            _cell(default),
            _cell(_DEFAULT.sub("", told)),
        )
    return rows


def _by_part(rows: Iterable[Row]) -> Iterator[str]:
    """The options in tables, one for each part of the config; of optimizers the rates of all."""
    parts: dict[str, list[Row]] = {}
    for row in rows:
        option = row[0].strip("`").split()[0]
        steps = option.removeprefix("--").split(".")
        part = ".".join(steps[: min(len(steps) - 1, 3)]) if option.startswith("--") else ""
        if steps[0] == "optimizers":
            part = "optimizers"
            if steps[1] != "position" and steps[-1] != "lr":
                continue  # of all groups alike
        parts.setdefault(part, []).append(row)
    for part, of_part in parts.items():
        if part:
            yield f"#### {part}"
        yield _table(("option", "default", "what it is"), of_part)


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in (head, ("---",) * len(head), *rows)]
    return "\n".join(lines)


def _plain(text: str) -> str:
    """A docstring's paragraphs, each on a line of its own."""
    return "\n\n".join(" ".join(part.split()) for part in text.strip().split("\n\n"))


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
