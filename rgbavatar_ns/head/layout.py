"""What the numbers of a theta vector mean: named fields with a size and a form."""

import functools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.rotations import (
    axis_angle_between,
    axis_angle_to_matrix,
    matrix_to_6d_rows,
)

ThetaForm = Literal["linear", "axis_angle", "translation"]
"""linear: blend weights; axis_angle: radians times unit axis; translation: metres."""
_LARGEST: dict[ThetaForm, tuple[float, str]] = {
    "linear": (100.0, "the largest weight"),
    "axis_angle": (4 * math.pi, "two turns, in radians"),
    "translation": (100.0, "metres from the origin"),
}
"""No person does more; trackers that lose the face do, and one such frame destroys a training."""
CARRIER_FIELDS = ("rotation", "neck")
"""What turns the head: the root, and the neck upon it."""
RIGID_FIELDS = (*CARRIER_FIELDS, "translation")
"""What moves the head as a whole; the other fields make the expression."""


@dataclass(frozen=True)
class ThetaField:
    """One named run of theta; rotations and translations have three numbers."""

    name: str
    size: int
    form: ThetaForm

    def __post_init__(self) -> None:
        if self.form not in get_args(ThetaForm):
            raise UserError(
                f"The theta field '{self.name}' has the form '{self.form}'.",
                f"Use one of {', '.join(get_args(ThetaForm))}.",
            )
        if self.size < 0 or (self.form != "linear" and self.size != 3):
            raise UserError(
                f"The theta field '{self.name}' of form {self.form} has size {self.size}.",
                "Rotations and translations have size 3, linear fields at least 0.",
            )


@dataclass(frozen=True)
class ThetaLayout:
    """The order of fields in theta; saved with every checkpoint and data set."""

    fields: tuple[ThetaField, ...]

    def __post_init__(self) -> None:
        if len(set(self.names)) != len(self.fields):
            raise UserError(
                f"A theta layout names a field twice: {', '.join(self.names)}.",
                "Give every field its own name.",
            )

    @property
    def names(self) -> tuple[str, ...]:
        """The fields' names in order."""
        return tuple(field.name for field in self.fields)

    @functools.cached_property
    def size(self) -> int:
        """How many numbers theta has."""
        return sum(field.size for field in self.fields)

    def __contains__(self, name: object) -> bool:
        """Whether there is a field of this name."""
        return name in self.names

    def slice(self, name: str) -> slice:
        """Where a field lies in theta; raises UserError for an unknown name."""
        start = 0
        for field in self.fields:
            if field.name == name:
                return slice(start, start + field.size)
            start += field.size
        raise self._unknown([name])

    def split(self, theta: Float[Tensor, "*batch H"]) -> dict[str, Float[Tensor, "*batch _"]]:
        """Theta's fields by name (views); raises UserError where the size differs."""
        if theta.shape[-1] != self.size:
            raise UserError(
                f"theta has {theta.shape[-1]} numbers, but the layout ({self}) has {self.size}.",
                "Use theta made for this head model, or map it field by field by name.",
            )
        parts = torch.split(theta, [field.size for field in self.fields], dim=-1)
        return dict(zip(self.names, parts))

    def join(self, parts: Mapping[str, Float[Tensor, "*batch _"]]) -> Float[Tensor, "*batch H"]:
        """Theta from fields by name; batch axes broadcast and a missing field is zero.

        Raises UserError for a name that the layout lacks, for a wrong size, and for no parts.
        """
        if not parts:
            raise UserError("No field of theta is given.", "Give at least one, for its batch axes.")
        unknown = [name for name in parts if name not in self]
        if unknown:
            raise self._unknown(unknown)
        for field in self.fields:
            if field.name in parts and parts[field.name].shape[-1] != field.size:
                raise UserError(
                    f"The theta field '{field.name}' has {parts[field.name].shape[-1]} numbers.",
                    f"This layout wants {field.size}.",
                )
        batch = torch.broadcast_shapes(*(part.shape[:-1] for part in parts.values()))
        like = next(iter(parts.values()))
        pieces = [
            parts[field.name].expand(*batch, field.size)
            if field.name in parts
            else like.new_zeros(*batch, field.size)
            for field in self.fields
        ]
        return torch.cat(pieces, dim=-1)

    def between(
        self, first: Float[Tensor, "*batch H"], second: Float[Tensor, "*batch H"], share: float
    ) -> Float[Tensor, "*batch H"]:
        """Theta a share in [0, 1] of the way from the first to the second, rotations by turning.

        0 and 1 give the two as they are; raises UserError where the size differs.
        """
        if share in (0.0, 1.0):
            return second if share else first
        starts, ends = self.split(first), self.split(second)
        parts = {
            field.name: axis_angle_between(starts[field.name], ends[field.name], share)
            if field.form == "axis_angle"
            else torch.lerp(starts[field.name], ends[field.name], share)
            for field in self.fields
        }
        return self.join(parts)

    def absurd(self, theta: Float[Tensor, "*batch H"]) -> str | None:
        """What no person can do, in words: a weight beyond 100, an angle beyond 4 pi, 100 m, NaN.

        None where all is within reason; raises UserError where the size differs.
        """
        for field, part in zip(self.fields, self.split(theta).values()):
            extents = part.abs() if field.form == "linear" else part.norm(dim=-1)
            largest, what = _LARGEST[field.form]
            if extents.numel() and not bool((extents <= largest).all()):
                return f"{field.name} reaches {float(extents.max()):g} ({largest:.4g}: {what})"
        return None

    def to_json(self) -> list[dict[str, Any]]:
        """The fields as plain values that JSON can hold."""
        return [
            {"name": field.name, "size": field.size, "form": field.form} for field in self.fields
        ]

    @classmethod
    def from_json(cls, values: Any) -> "ThetaLayout":
        """Inverse of `to_json`; raises UserError for anything else."""
        try:
            if not isinstance(values, list | tuple):
                raise ValueError("it is no list of fields")
            if any(not isinstance(f, dict) or set(f) != {"name", "size", "form"} for f in values):
                raise ValueError("every field needs exactly name, size and form")
            if any(not isinstance(f["name"], str) or type(f["size"]) is not int for f in values):
                raise ValueError("a name is no text, or a size no whole number")
            return cls(tuple(ThetaField(f["name"], f["size"], f["form"]) for f in values))
        except (TypeError, ValueError, OverflowError) as error:
            raise UserError(
                f"This is not a theta layout: {error}.",
                "Take the list of fields that ThetaLayout.to_json wrote.",
            ) from None

    def feature_size(self, include_pose: bool = True, include_translation: bool = False) -> int:
        """How many numbers `network_features` gives."""
        theta = torch.zeros(self.size)
        return self.network_features(theta, include_pose, include_translation).shape[-1]

    def network_features(
        self,
        theta: Float[Tensor, "*batch H"],
        include_pose: bool = True,
        include_translation: bool = False,
    ) -> Float[Tensor, "*batch F"]:
        """Theta as the weight network reads it (paper, sec. 3.1: expression and joint poses).

        Rotations become the first two rows of their matrix, as in the release, or are left out;
        the translation is left out by default, ours, because an avatar must not change its look
        when the head moves sideways.
        """
        parts = self.split(theta)
        read = self.feature_parts(include_pose, include_translation)
        # All rotations at once: single ones are too small for a tensor operation each.
        turning = [name for name, turned in read if turned]
        rows_6d = {}
        if turning:
            matrices = axis_angle_to_matrix(torch.stack([parts[name] for name in turning], -2))
            rows_6d = dict(zip(turning, matrix_to_6d_rows(matrices).unbind(-2)))
        features = [rows_6d[name] if turned else parts[name] for name, turned in read]
        return torch.cat([theta[..., :0], *features], dim=-1)

    def feature_parts(
        self, include_pose: bool = True, include_translation: bool = False
    ) -> list[tuple[str, bool]]:
        """The fields that `network_features` reads, in order, and whether by their matrix' rows."""
        forms = {"linear": True, "axis_angle": include_pose, "translation": include_translation}
        return [(f.name, f.form == "axis_angle") for f in self.fields if forms[f.form]]

    def __str__(self) -> str:
        """Names and sizes in a line."""
        return ", ".join(f"{field.name} {field.size}" for field in self.fields)

    def _unknown(self, names: Iterable[str]) -> UserError:
        return UserError(
            f"Unknown theta field: {', '.join(names)}.", f"This layout has {', '.join(self.names)}."
        )
