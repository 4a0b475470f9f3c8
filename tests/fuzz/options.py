"""Absurd values of every option of every command, and of ns-train's configs."""

import copy
import dataclasses
import importlib
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np

from rgbavatar_ns.cli import main as cli
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.methods import rgbavatar
from rgbavatar_ns.plugin.online.methods import rgbavatar_online
from rgbavatar_ns.plugin.training.ranges import require_trainable

NAME = "options"
_ABSURD = ("-3", "0", "nan", "inf", "-inf", "1e400", str(10**12), str(10**30), "x", "", "-1e-30")
_POSITIONAL = {
    "demo-data": ("file",),
    "track": ("none.mp4", "file"),
    "import": ("none", "out"),
    "check": ("none",),
    "render": ("none", "out"),
    "export": ("none", "out"),
    "sweep": ("none.yaml",),
    "report": ("none", "--file", "none.yaml"),
    "demo": ("--output", "file"),
}
"""What makes each command end soon whatever its options are: inputs that are not there, or a
destination that is a file."""


def _option_names(command: str) -> list[str]:
    """The options that a command declares, also those of its groups."""
    module = importlib.import_module(
        f"rgbavatar_ns.cli.{cli._MODULES.get(command, command.replace('-', '_'))}"
    )
    names = []
    for name, hint in get_type_hints(module.run).items():
        within = get_type_hints(hint) if dataclasses.is_dataclass(hint) else {name: hint}
        names += [name for name, kind in within.items() if {int, float} & {kind, *get_args(kind)}]
    return ["--" + name.replace("_", "-") for name in names]


def cases(seed: int, count: int) -> Iterator[tuple[str, Callable[[], object]]]:
    """Each sets one to three options to absurd values."""
    random = np.random.default_rng(seed)
    options = {command: _option_names(command) for command in _POSITIONAL}
    options = {command: names for command, names in options.items() if names}
    folder = Path(tempfile.mkdtemp())
    (folder / "file").write_text("mine")
    for number in range(count):
        if number % 2:
            config = [rgbavatar, rgbavatar_online][number // 2 % 2].config
            yield _configured(config, random)
            continue
        command = str(random.choice(list(options)))
        words = list(_POSITIONAL[command])
        for name in random.choice(options[command], random.integers(1, 4)):
            words += [str(name), str(random.choice(_ABSURD))]
        words = [str(folder / w) if w in ("file", "none", "out") else w for w in words]
        yield f"rgbavatar {command} {' '.join(words)}", _refused([command, *words])


def _refused(words: list[str]) -> Callable[[], object]:
    def act() -> None:
        try:
            cli.main(words)
        except SystemExit as ended:
            if ended.code in (1, 2):
                raise UserError("refused", "") from None
        raise AssertionError("the command went through")

    return act


def _configured(config: Any, random: np.random.Generator) -> tuple[str, Callable[[], object]]:
    """A trainer's config with one number anywhere within it made absurd."""
    config = copy.deepcopy(config)
    path, owner = "", config
    while True:
        fields = [
            field.name
            for field in dataclasses.fields(owner)
            if _is_group(value := getattr(owner, field.name))
            or (isinstance(value, int | float) and not isinstance(value, bool))
        ]
        if not fields:
            return f"{path} has no numbers", lambda: None
        name = str(random.choice(fields))
        value, path = getattr(owner, name), f"{path}.{name}"
        if not _is_group(value):
            break
        owner = value
    absurd = random.choice([-3, 0, float("nan"), float("inf"), 10**12, -(10**30)])
    absurd = absurd if isinstance(value, float) or absurd != absurd else int(min(absurd, 10**30))
    object.__setattr__(owner, name, absurd)
    return f"config{path} = {absurd}", lambda: require_trainable(config)


def _is_group(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)
