"""Which options a command's help shows first."""

from collections.abc import Callable
from typing import TypeVar

Config = TypeVar("Config")


def led_by(*names: str) -> Callable[[type[Config]], type[Config]]:
    """Decorate a dataclass so that help shows these fields first, the others as they were declared.

    Otherwise a base class's fields come first, which are nerfstudio's. Only the list of the fields
    changes, and a class that inherits has an order of its own. Raises KeyError for a name that is
    no field.
    """

    def ordered(config: type[Config]) -> type[Config]:
        fields = config.__dataclass_fields__  # type: ignore[attr-defined]
        config.__dataclass_fields__ = {name: fields[name] for name in names} | fields  # type: ignore[attr-defined]
        return config

    return ordered
