"""What an avatar is made of: sizes, variants and initial values."""

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from rgbavatar_ns.errors import UserError

_ABSURD = 1 << 31


@dataclass(frozen=True)
class AvatarConfig:
    """Choices that fix an avatar's parameters and how they become world-space Gaussians."""

    num_bases: int = 20
    """Number K of Gaussian blendshapes (paper: 20); 0 leaves the base model alone."""
    uv_resolution: int = 256
    """Side of the UV map whose covered texels carry one Gaussian each (paper: 256)."""
    weight_network: Literal["mlp", "linear", "none"] = "mlp"
    """Map from theta to the blendshape weights (paper: mlp; linear is an ablation of it). With none
    the first num_bases expression coefficients are the weights (its "w/o reducing")."""
    hidden_width: int = 128
    """Width of the weight network's two hidden layers."""
    tangent_variant: Literal["normalized", "raw", "orthonormal"] = "normalized"
    """Tangent frames: unit columns, the paper's Algorithm 1 to the letter, or Gram-Schmidt."""
    pose_input: bool = True
    """Whether the weight network sees joint and head rotations (paper: yes)."""
    translation_input: bool = False
    """Whether it sees the head's translation; off, so that moving sideways changes nothing."""
    carrier: Literal["mesh", "joints"] = "mesh"
    """What carries the Gaussians: tangent frames of the mesh that theta deforms, or of a mesh that
    only its joints move, not its expressions (the paper's ablation "w/o tangent space")."""
    scale_with_triangle: bool = False
    """Whether Gaussians grow and shrink with their triangle (paper: no)."""
    initial_scale_m: float = 8e-4
    """Initial standard deviation of every Gaussian in metres."""
    scale_from_texel_spacing: bool = False
    """Take the initial scale from the distance of neighbouring texels on the head instead."""
    initial_opacity: float = 0.5
    """Initial opacity, inside (0, 1)."""
    initial_color: float = 0.5
    """Initial grey value."""

    def __post_init__(self) -> None:
        """Refuse values that cannot make an avatar."""
        problems = [
            (self.num_bases < 0, "num_bases", "0 or more"),
            (self.uv_resolution < 1, "uv_resolution", "1 or more"),
            (self.hidden_width < 1, "hidden_width", "1 or more"),
            (not self.initial_scale_m > 0, "initial_scale_m", "a length above 0"),
            (not 0 < self.initial_opacity < 1, "initial_opacity", "a value between 0 and 1"),
        ]
        for name, choices in (
            ("weight_network", ("mlp", "linear", "none")),
            ("carrier", ("mesh", "joints")),
            ("tangent_variant", ("normalized", "raw", "orthonormal")),
        ):
            *others, last = map(repr, choices)
            wanted = f"{', '.join(others)} or {last}"
            problems.append((getattr(self, name) not in choices, name, wanted))
        for wrong, name, wanted in problems:
            if wrong:
                value = getattr(self, name)
                raise UserError(f"The avatar's {name} is {value!r}.", f"Give {wanted}.")

    def to_json(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "AvatarConfig":
        """Build from `to_json`; raises UserError on a field unknown to this version or misfit."""
        kinds: dict[str, Any] = {field.name: field.type for field in fields(cls)}
        unknown = sorted(set(values) - set(kinds))
        if unknown:
            raise UserError(
                f"The avatar's settings contain {', '.join(unknown)}, unknown to this version.",
                "Update rgbavatar_ns to the version that wrote them.",
            )
        for name, value in values.items():
            kind = kinds[name] if isinstance(kinds[name], type) else str
            # JSON writes 1.0 as it likes, and knows NaN.
            fits = type(value) in (int, float) if kind is float else type(value) is kind
            if not fits or (kind is not str and not abs(value) < _ABSURD):
                raise UserError(
                    f"The avatar's {name} is {value!r}, which is no {kind.__name__} of use.",
                    "Save the avatar again, or use another copy.",
                )
        return cls(**values)
