"""What is wrong with a dataset, in words and for programs, and the verdict on it."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from rgbavatar_ns.data.importers.flame_parameters import FlameVersionError
from rgbavatar_ns.errors import UserError

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class Finding:
    """Something amiss: an error spoils the data, a warning asks to look.

    kind: a stable word for programs: "unreadable", "axes", "focal length", "principal point",
    "mirrored", "frame offset", "outside", "misfit", "FLAME version", "parameters", "cameras",
    "mattes", "landmarks", "faces", "gaze", "camera", "body".
    """

    kind: str
    severity: Severity
    cause: str


@dataclass(frozen=True)
class Problem(Finding):
    """A finding with what a user can do about it."""

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
        return {**asdict(self), "frames": list(self.frames)}


def usable(findings: Iterable[Finding]) -> bool:
    """Whether nothing that was found is an error."""
    return not any(finding.severity == "error" for finding in findings)


def verdict(findings: Iterable[Finding]) -> str:
    """The findings in words, errors first: "good", "usable: ..." or "look at it: ..."."""
    ordered = sorted(findings, key=lambda finding: finding.severity)
    if not ordered:
        return "good"
    causes = "; ".join(finding.cause.removesuffix(".") for finding in ordered)
    return f"{'usable' if usable(ordered) else 'look at it'}: {causes}"
