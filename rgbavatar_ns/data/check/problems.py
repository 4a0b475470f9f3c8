"""What is wrong with a dataset, in words and for programs."""

from dataclasses import dataclass
from typing import Any, Literal

from rgbavatar_ns.data.importers.flame_parameters import FlameVersionError
from rgbavatar_ns.errors import UserError

Severity = Literal["error", "warning"]
_SHOWN = 5


@dataclass(frozen=True)
class Problem:
    """One finding; an error makes the data unusable, a warning asks to look.

    kind: a stable word for programs: "unreadable", "axes", "focal length", "principal point",
    "mirrored", "frame offset", "outside", "misfit", "FLAME version", "parameters", "cameras",
    "mattes".
    """

    kind: str
    severity: Severity
    cause: str
    remedy: str
    frames: tuple[int, ...] = ()
    """Numbers of the frames that it is about; none: all."""

    @classmethod
    def of_error(cls, error: UserError) -> "Problem":
        """What a reader of the dataset refused."""
        kind = "FLAME version" if isinstance(error, FlameVersionError) else "unreadable"
        return cls(kind, "error", error.cause, error.remedy)

    def as_error(self) -> UserError:
        """For those who cannot go on."""
        return UserError(self.cause, self.remedy)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "kind": self.kind,
            "severity": self.severity,
            "cause": self.cause,
            "remedy": self.remedy,
            "frames": list(self.frames),
        }


def first_few(numbers: tuple[int, ...]) -> str:
    """The first numbers, and that there are more."""
    shown = ", ".join(map(str, numbers[:_SHOWN]))
    return shown if len(numbers) <= _SHOWN else f"{shown}, ..."
