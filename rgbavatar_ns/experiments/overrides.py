"""Overrides of a preset, checked against its typed config before anything runs."""

import copy
import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any

from typeguard import TypeCheckError, check_type

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.spec import Overrides, nearest
from rgbavatar_ns.options import CheckedOptions


def check_overrides(config: Any, overrides: Overrides, where: str) -> None:
    """Raise UserError unless every key is a field of `config` and takes the value given.

    `config` is a preset's dataclass; keys are dotted as in `pipeline.model.avatar.num_bases`.
    An unknown key is told with the nearest right one.
    """
    for key, value in overrides.items():
        _check(config, key, value, where)


def with_overrides(config: Any, overrides: Overrides) -> Any:
    """A copy of a preset's config with the overrides in it, which `check_overrides` has passed."""
    for key, value in overrides.items():
        config = _replaced(config, key.split("."), value)
    return config


def _replaced(part: Any, path: Sequence[str], value: Any) -> Any:
    name, *rest = path
    if isinstance(part, Mapping):
        return {**part, name: _replaced(part[name], rest, value)}
    if rest:
        value = _replaced(getattr(part, name), rest, value)
    else:
        value = _as_config(value, typing.get_type_hints(type(part))[name])
    changed = copy.copy(part)
    object.__setattr__(changed, name, value)  # frozen ones too
    return changed


def check_together(config: Any) -> None:
    """Raise UserError where options refuse one another, as they do on a command line."""
    if isinstance(config, CheckedOptions):
        config.__post_init__()
    if dataclasses.is_dataclass(config):
        for part in vars(config).values():
            check_together(part)


def _check(config: Any, key: str, value: Any, where: str) -> None:
    *path, last = key.split(".")
    part, walked = config, []
    for name in path:
        part = _require_field(part, name, key, walked, where)
        part = part[name] if isinstance(part, Mapping) else getattr(part, name)
        walked.append(name)
    _require_field(part, last, key, walked, where)
    if isinstance(part, Mapping):
        raise UserError(
            f"{where} sets {key}, which is no single option.", "Name one of its fields."
        )
    hint = typing.get_type_hints(type(part))[last]
    try:
        check_type(_as_config(value, hint), hint)
    except TypeCheckError:
        raise UserError(
            f"{where} sets {key} to {value!r}, which does not fit its type {_told(hint)}.",
            "Give a value of that type.",
        ) from None


def _require_field(part: Any, name: str, key: str, walked: list[str], where: str) -> Any:
    names = list(map(str, part)) if isinstance(part, Mapping) else []
    if dataclasses.is_dataclass(part):
        names = [field.name for field in dataclasses.fields(part)]
    if name not in names:
        known = [".".join([*walked, field]) for field in names if not field.startswith("_")]
        raise UserError(
            f"{where} sets {key}, and {'.'.join([*walked, name])} is no field of the preset.",
            nearest(".".join([*walked, name]), known or [".".join(walked)]),
        )
    return part


def _as_config(value: Any, hint: Any) -> Any:
    """YAML's lists where the config has tuples, its whole numbers where that has floats."""
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    options = typing.get_args(hint) if union else (hint,)
    if isinstance(value, list) and any(typing.get_origin(option) is tuple for option in options):
        return tuple(value)
    if isinstance(value, int) and not isinstance(value, bool) and float in options:
        return value if int in options else float(value)
    return value


def _told(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) else str(hint).replace("typing.", "")


def as_flags(overrides: Mapping[str, Any]) -> list[str]:
    """The overrides as ns-train's command line takes them."""
    flags: list[str] = []
    for key, value in overrides.items():
        flags.append(f"--{key.replace('_', '-')}")
        values = value if isinstance(value, list | tuple) else [value]
        flags += [str(one) for one in values]
    return flags
