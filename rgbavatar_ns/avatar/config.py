"""What an avatar is made of: sizes, variants and initial values."""

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from rgbavatar_ns.errors import UserError


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
            (self.num_bases < 0, f"num_bases is {self.num_bases}", "0 or more"),
            (self.uv_resolution < 1, f"uv_resolution is {self.uv_resolution}", "1 or more"),
            (self.hidden_width < 1, f"hidden_width is {self.hidden_width}", "1 or more"),
            (
                self.weight_network not in ("mlp", "linear", "none"),
                f"weight_network is {self.weight_network!r}",
                "'mlp', 'linear' or 'none'",
            ),
            (
                self.carrier not in ("mesh", "joints"),
                f"carrier is {self.carrier!r}",
                "'mesh' or 'joints'",
            ),
            (
                self.tangent_variant not in ("normalized", "raw", "orthonormal"),
                f"tangent_variant is {self.tangent_variant!r}",
                "'normalized', 'raw' or 'orthonormal'",
            ),
            (
                not self.initial_scale_m > 0,
                f"initial_scale_m is {self.initial_scale_m}",
                "a length above 0",
            ),
            (
                not 0 < self.initial_opacity < 1,
                f"initial_opacity is {self.initial_opacity}",
                "a value between 0 and 1",
            ),
        ]
        for wrong, cause, wanted in problems:
            if wrong:
                raise UserError(f"The avatar's {cause}.", f"Give {wanted}.")

    def to_json(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "AvatarConfig":
        """Build from `to_json`; raises UserError on a field that this version does not know."""
        unknown = sorted(set(values) - {field.name for field in fields(cls)})
        if unknown:
            raise UserError(
                f"The avatar's settings contain {', '.join(unknown)}, unknown to this version.",
                "Update rgbavatar_ns to the version that wrote them.",
            )
        return cls(**values)
