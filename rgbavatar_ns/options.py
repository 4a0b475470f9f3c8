"""Ranges and choices of options, written where an option is declared and checked in one place."""

import dataclasses
import inspect
import itertools
import math
from collections.abc import Mapping, Sequence
from functools import cache
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NoReturn,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from rgbavatar_ns.errors import UserError


@dataclasses.dataclass(frozen=True)
class Between:
    """Bounds of a number, both allowed unless `open`; attached to a type by `Annotated`."""

    low: int | float
    high: int | float
    open: bool = False

    def holds(self, value: int | float) -> bool:
        """Whether a value is one of them; NaN never is."""
        if self.open:
            return self.low < value < self.high
        return self.low <= value <= self.high

    def __str__(self) -> str:
        kind = " (both excluded)" if self.open else ""
        return f"from {_number(self.low)} to {_number(self.high)}{kind}"


Ranges = Mapping[type, Mapping[str, Between]]
"""Bounds by class and name."""
Count = Annotated[int, Between(1, 10**9)]
"""How many: at least one."""
Counted = Annotated[int, Between(0, 10**9)]
"""How many: zero too."""
Pixels = Annotated[int, Between(1, 8192)]
"""The side of an image."""
Seed = Annotated[int, Between(0, 2**32 - 1)]
"""As NumPy takes it."""
FRAME_RATES = Between(0.01, 1000.0)
FrameRate = Annotated[float, FRAME_RATES]
"""Frames per second."""
Share = Annotated[float, Between(0.0, 1.0)]
"""A part of a whole."""
Weight = Annotated[float, Between(0.0, 1e6)]
"""A factor; zero switches off."""
Positive = Annotated[float, Between(1e-9, 1e9)]
"""A length, a rate, a factor."""


def check_options(
    owner: Any, values: Mapping[str, Any], prefix: str = "", more: Ranges | None = None
) -> None:
    """Raise UserError for the first value that leaves the range or choices of its annotation.

    owner: the class or function whose annotations declare the options; `more` has ranges of
    classes whose declarations are not ours, and whose choices are not checked. Tuples are checked
    item by item, dataclasses and mappings within as well. prefix: of the options' names in an
    error.
    """
    declared, choices = _declared_bounds(owner), {}
    if isinstance(owner, type) and issubclass(owner, CheckedOptions):
        choices = _declared_choices(owner)
    others: dict[str, Between] = {}
    for kind in inspect.getmro(owner) if isinstance(owner, type) else ():
        others.update((more or {}).get(kind, {}))
    for name, value in values.items():
        bounds = [others[name]] if name in others else declared.get(name, ())
        for item in value if isinstance(value, tuple | list) else (value,):
            for bound in bounds:
                _check(prefix + name, item, bound)
            if name in choices and item not in choices[name]:
                _refuse_choice(prefix + name, item, choices[name])
            _check_within(item, f"{prefix}{name}.", more)


@cache
def _declared_bounds(owner: Any) -> Mapping[str, Sequence[Between]]:
    """The bounds of each name that a class or function annotates."""
    hints = get_type_hints(owner, include_extras=True)
    return {name: _bounds(hint) for name, hint in hints.items()}


@cache
def _declared_choices(owner: Any) -> Mapping[str, tuple[Any, ...]]:
    """What each name that is annotated as one of some words, or None, can be."""
    found = {}
    for name, hint in get_type_hints(owner).items():
        kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        words = [get_args(kind) for kind in kinds if get_origin(kind) is Literal]
        rest = [kind for kind in kinds if get_origin(kind) is not Literal]
        if words and all(kind is type(None) for kind in rest):
            found[name] = (*itertools.chain(*words), *(None for _ in rest))
    return found


def _check_within(value: Any, prefix: str, more: Ranges | None) -> None:
    if isinstance(value, dict):
        for key, item in value.items():
            _check_within(item, f"{prefix}{key}.", more)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        check_options(type(value), vars(value), prefix, more)


class CheckedOptions:
    """Base of the dataclasses of options: refuses what is out of range as they are made."""

    def __post_init__(self) -> None:
        """Raise UserError for a value that leaves its range or choices."""
        check_options(type(self), vars(self))


def _bounds(hint: Any) -> list[Between]:
    """The bounds anywhere in an annotation: of the number, its alternatives or its items."""
    found = []
    if get_origin(hint) is Annotated:
        found += [extra for extra in get_args(hint)[1:] if isinstance(extra, Between)]
    for part in get_args(hint):
        if not isinstance(part, Between):
            found += _bounds(part)
    return found


def _number(value: int | float) -> str:
    return f"{int(value):,}" if value == int(value) else f"{value:g}"


def _check(name: str, value: Any, bounds: Between) -> None:
    if value is None or isinstance(value, str):
        return
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or math.isnan(value) or not bounds.holds(value):
        option = "--" + name.replace("_", "-")
        raise UserError(f"{option} is {value!r}.", f"Give a number {bounds}.")


def _refuse_choice(name: str, value: object, choices: tuple[Any, ...]) -> NoReturn:
    *others, last = map(repr, choices)
    option = "--" + name.replace("_", "-")
    allowed = f"{', '.join(others)} or {last}" if others else last
    raise UserError(f"{option} is {value!r}.", f"Give {allowed}.")
