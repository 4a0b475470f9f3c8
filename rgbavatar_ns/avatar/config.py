"""What an avatar is made of: sizes, variants and initial values."""

from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Annotated, Any, Literal, TypeVar

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import Between, CheckedOptions, Share

Kind = TypeVar("Kind", bound="MethodConfig")


@dataclass(frozen=True)
class MethodConfig(CheckedOptions):
    """The options of a method, each with a default, as its files keep them."""

    def to_json(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls: type[Kind], values: dict[str, Any]) -> Kind:
        """Build from `to_json`; raises UserError on a field unknown to this version or misfit."""
        return _from_json(cls, values)


@dataclass(frozen=True)
class AvatarConfig(MethodConfig):
    """Choices that fix an avatar's parameters and how they become world-space Gaussians."""

    num_bases: Annotated[int, Between(0, 1000)] = 20
    """Number K of Gaussian blendshapes (paper, release: 20); 0 leaves the base model alone."""
    uv_resolution: Annotated[int, Between(1, 4096)] = 256
    """Side of the UV map whose covered texels carry one Gaussian each (paper, release: 256)."""
    weight_network: Literal["mlp", "linear", "none"] = "mlp"
    """Map from theta to the blendshape weights (paper: mlp; linear is an ablation of it). With none
    the first num_bases expression coefficients are the weights (its "w/o reducing")."""
    hidden_width: Annotated[int, Between(1, 8192)] = 128
    """Width of the weight network's two hidden layers (paper, release: 128)."""
    tangent_variant: Literal["normalized", "raw", "orthonormal"] = "normalized"
    """Tangent frames of a triangle: raw, columns as Algorithm 1 leaves them (paper); normalized,
    unit columns (release); orthonormal, by Gram-Schmidt (ours)."""
    pose_input: bool = True
    """Whether the weight network sees joint and head rotations (paper, release: yes)."""
    translation_input: bool = False
    """Whether it sees the head's translation (release: yes; the paper names expression coefficients
    and joint poses alone): off, so that moving sideways changes nothing."""
    theta_within_film: bool = True
    """Hold theta near what training saw before the weight network takes it: ours, because weights
    of what it never saw run away with the bases. False takes theta as it is (paper, release)."""
    carrier: Literal["mesh", "joints"] = "mesh"
    """What carries the Gaussians: tangent frames of the mesh that theta deforms, or of a mesh that
    only its joints move, not its expressions (the paper's ablation "w/o tangent space")."""
    scale_with_triangle: bool = False
    """Whether Gaussians grow and shrink with their triangle (paper, release: no)."""
    initial_scale_m: Annotated[float, Between(1e-7, 1)] = 8e-4
    """Initial standard deviation of every Gaussian in metres (paper: "a default value"; release:
    .0008); with a surface prior wider where half of what texels lie apart is more."""
    scale_from_texel_spacing: bool = False
    """Take the initial scale from the distance of neighbouring texels on the head instead: ours,
    for fewer Gaussians than the paper's."""
    initial_opacity: Annotated[float, Between(0, 1, open=True)] = 0.5
    """Initial opacity, inside (0, 1) (paper: "a default value"; release: .5); with a surface prior
    .9 at mouth and lips, and all over FLAME's head, whose lips nobody has pointed out."""
    initial_color: Share = 0.5
    """Initial grey value (paper: "a default value"; release: .5)."""


def _from_json(kind: type[Any], values: dict[str, Any]) -> Any:
    defaults = kind()
    known: dict[str, Any] = {field.name: getattr(defaults, field.name) for field in fields(kind)}
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise UserError(
            f"The avatar's settings contain {', '.join(unknown)}, unknown to this version.",
            "Update rgbavatar_ns to the version that wrote them.",
        )
    read = dict(values)
    for name, value in values.items():
        wanted = type(known[name])
        if is_dataclass(wanted) and isinstance(value, dict):
            read[name] = _from_json(wanted, value)
        # JSON may write 1.0 as 1.
        elif type(value) is not wanted and (type(value), wanted) != (int, float):
            raise UserError(
                f"The avatar's {name} is {value!r}, which is no {wanted.__name__}.",
                "Save the avatar again, or use another copy.",
            )
    return kind(**read)
