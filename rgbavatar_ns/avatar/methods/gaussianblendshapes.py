"""GaussianBlendshapes-style (Ma et al. 2024): a neutral head, and a basis for each expression.

Facts are from the paper and its release: config/config_blendshapes.py, train.py,
FLAME/face_gs_model.py, FLAME/mouth_gs_model.py, FLAME/transforms.py. All rows of this project's
table of the baselines are in:

- Initial: 50,000 points spread over the face and 5,000 over each row of teeth, grey, opacity .1,
  scales by the nearest neighbours. Ours: darts in place of the release's Poisson
  disks, and the head model's teeth in place of its two billboards (a head without teeth has no
  Gaussians there).
- Motion: theta's expressions are the weights. Bases are fixed from the head model's deformation
  (positions and rotations) plus learned residuals of every attribute, times the displacement mask;
  eyelids and pose blendshapes are fixed alone. Blend skinning carries them and turns colours. Upper
  teeth move with the head, lower ones with the jaw. Ours: deformation is interpolated between
  vertices, where the release has one value a triangle, and pose blendshapes as well, where it takes
  the sum of a triangle's three corners; bounds of the mask are found in the head model, where the
  release writes down FLAME's.
- Colours: harmonics of degree 3, one degree more every 1,000 steps.
- Loss, rates, density control: as the table has them. No opacity is reset.

Left out: what the release switches off itself (LPIPS, isotropic scales, updates of the mask);
rotations that expressions give to harmonics, which it takes once from colours that have none yet;
FLAME's neck, whose residuals it holds at 0. Its backgrounds are black, here the training's.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.config import MethodConfig
from rgbavatar_ns.avatar.method import AvatarMethod, DrawnBatch, FilmedBatch, Losses, WatchedStep
from rgbavatar_ns.avatar.methods.carriers import skinning_frames
from rgbavatar_ns.avatar.methods.density import (
    ControlledGaussians,
    DensityControl,
    ScreenStatistics,
    control,
    sampled_positions,
)
from rgbavatar_ns.avatar.methods.expression_bases import ExpressionBases, basis_weights
from rgbavatar_ns.avatar.methods.gaussian_rows import GaussianRows
from rgbavatar_ns.avatar.methods.head_regions import faces_within, group_vertices
from rgbavatar_ns.avatar.methods.loss_terms import (
    coverage_loss,
    cylinder_term,
    dssim_loss,
    held_where,
    upright_cylinder,
)
from rgbavatar_ns.avatar.methods.mesh_points import spread_points
from rgbavatar_ns.avatar.methods.neighbours import neighbour_distance
from rgbavatar_ns.avatar.methods.sh import (
    ShownDegree,
    directions_in_frames,
    num_coefficients,
    sh_colors,
    view_directions,
)
from rgbavatar_ns.avatar.model.image_loss import l1_loss
from rgbavatar_ns.avatar.model.tangent_to_world import carried
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, HeadModel
from rgbavatar_ns.head.joints import JAW, NECK
from rgbavatar_ns.head.rotations import quat_wxyz_to_matrix
from rgbavatar_ns.head.surface import interpolated
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.options import Between, Count, Counted, Positive, Share, Weight

_FEWEST_POINTS = 4

Degree = Annotated[int, Between(0, 3)]


@dataclass(frozen=True)
class GaussianBlendshapesConfig(MethodConfig):
    """Options of the GaussianBlendshapes-style method; unless said, defaults are the release's."""

    num_points: Annotated[int, Between(_FEWEST_POINTS, 1_000_000)] = 50_000
    """Gaussians of the face at the start; each row of teeth has a tenth as many."""
    num_bases: Counted = 52
    """First expressions that learn a basis (release: 50 of FLAME's 100; 52 are all of the embedded
    head's), or as many as the head has; others only move what is there."""
    sh_degree: Degree = 3
    """Degree of the colours' harmonics in the end."""
    basis_sh_degree: Degree = 3
    """Degree up to which bases change harmonics; below 3, ours, they take less memory and time."""
    sh_degree_every: Count = 1000
    """Steps until the degree grows by one."""
    initial_opacity: Annotated[float, Between(0, 1, open=True)] = 0.1
    """Opacity at the start."""
    dssim_weight: Share = 0.2
    """Share of DSSIM in the loss; the rest is L1."""
    coverage_weight: Weight = 10.0
    """Of the squared difference of drawn opacity and matte."""
    mouth_weight: Weight = 100.0
    """Of how far teeth are outside of a cylinder about the mouth, in square metres."""
    position_decay_steps: Count = 30_000
    """Steps over which the rate of positions falls to a hundredth."""
    density: DensityControl = field(
        default_factory=lambda: DensityControl(gradient_threshold=1e-3, reset_every=0)
    )
    """Density control of the face."""
    teeth_gradient_threshold: Positive = 2e-4
    """From which teeth are cloned or split; all else as the face."""

    def __post_init__(self) -> None:
        """Refuse what density control could only do with Gaussians of triangles."""
        super().__post_init__()
        if self.density.keep_one_per_face:
            raise UserError(
                "density.keep_one_per_face is True, and this method's Gaussians lie on no "
                "triangle.",
                "Leave it out.",
            )


class _AtRest(NamedTuple):
    """Attributes as weights have them, before bones; harmonics only as far as they are shown."""

    position: Float[Tensor, "#B N 3"]
    rotation_wxyz: Float[Tensor, "#B N 4"]
    log_scale: Float[Tensor, "#B N 3"]
    opacity_logit: Float[Tensor, "#B N"]
    color: Float[Tensor, "#B N C 3"]


class _Splats(nn.Module):
    """Gaussians of the head at rest, in metres: every tensor has a row for each of them.

    Without `bases` no expression moves them.
    """

    skinning: Float[Tensor, "N 5"]

    def __init__(
        self,
        position: Float[Tensor, "N 3"],
        skinning: Float[Tensor, "N 5"],
        config: GaussianBlendshapesConfig,
        bases: ExpressionBases | None = None,
    ) -> None:
        super().__init__()
        count, opacity = len(position), config.initial_opacity
        rotation = position.new_zeros(count, 4)
        rotation[:, 0] = 1
        logit = position.new_full((count,), math.log(opacity / (1 - opacity)))
        further = num_coefficients(config.sh_degree) - 1
        self.position = nn.Parameter(position.clone())
        self.rotation_wxyz = nn.Parameter(rotation)
        self.log_scale = nn.Parameter(neighbour_distance(position).log()[:, None].repeat(1, 3))
        self.opacity_logit = nn.Parameter(logit)
        self.color = nn.Parameter(position.new_zeros(count, 1, 3))
        self.color_rest = nn.Parameter(position.new_zeros(count, further, 3))
        self.register_buffer("skinning", skinning)
        self.statistics = ScreenStatistics(count)
        self.bases = bases
        self.rows = GaussianRows(self, dict(self.named_parameters()) | dict(self.named_buffers()))

    def at_rest(self, weights: Float[Tensor, "B P"], degree: int) -> _AtRest:
        """What these weights make of the neutral head."""
        further = num_coefficients(degree) - 1
        color = torch.cat([self.color, self.color_rest[:, :further]], 1)[None]
        parts = (self.position, self.rotation_wxyz, self.log_scale, self.opacity_logit)
        position, rotation, log_scale, opacity = (part[None] for part in parts)
        bases = self.bases
        if bases is None:
            return _AtRest(position, rotation, log_scale, opacity, color)
        moved, turned = bases.displaced(weights)
        own = bases.own_weights(weights)
        changed = bases.residual("color", own, 3 * (1 + further)).unflatten(-1, (-1, 3))
        missing = color.shape[2] - changed.shape[2]
        return _AtRest(
            position + moved + bases.residual("position", own),
            rotation + turned + bases.residual("rotation_wxyz", own),
            log_scale + bases.residual("log_scale", own),
            opacity + bases.residual("opacity_logit", own)[..., 0],
            color + F.pad(changed, (0, 0, 0, missing)),
        )

    def controlled(self) -> ControlledGaussians:
        """As density control takes them."""

        def split(
            chosen: Int[Tensor, "M"], samples: Float[Tensor, "M S 3"]
        ) -> Mapping[str, Tensor]:
            place, rotation = self.position[chosen], self.rotation_wxyz[chosen]
            scale = self.log_scale[chosen].exp()
            return {"position": sampled_positions(place, rotation, scale, samples)}

        return ControlledGaussians(
            self.rows, self.statistics, lambda: self.log_scale.detach().exp(), split
        )


class GaussianBlendshapes(AvatarMethod):
    """A GaussianBlendshapes-style avatar: see this module.

    Args:
        head: the head model, whose layout names what theta holds.
        identity: the subject's identity coefficients, fixed.
        config: the options.
        seed: of where Gaussians begin.
    """

    method = "gaussianblendshapes-style"
    config_type = GaussianBlendshapesConfig
    config: GaussianBlendshapesConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    shown_degree: Int[Tensor, ""]
    mouth_centre: Float[Tensor, "3"]

    def __init__(
        self,
        head: HeadModel,
        identity: Float[Tensor, "I"],
        config: GaussianBlendshapesConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        config = GaussianBlendshapesConfig() if config is None else config
        super().__init__(head, identity, config)
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            rest = head(identity.new_zeros(self.layout.size), identity)
            teeth = {
                bone: faces_within(head.arrays, head.faces, name)
                for name, bone in (("upper_teeth", NECK), ("lower_teeth", JAW))
            }
            skin = ~torch.stack(list(teeth.values())).any(0)
            self.face = self._face(rest, head.faces[skin], generator)
            self.teeth = self._teeth(rest, teeth, generator)
        self._shown = ShownDegree(self, "shown_degree", config.sh_degree)
        rows = group_vertices(head.arrays, ("upper_teeth", "lower_teeth")).to(rest.device)
        centre, self.mouth_radius_m, self.mouth_half_height_m = upright_cylinder(rest[rows])
        self.register_buffer("mouth_centre", centre, persistent=False)

    def _face(
        self, rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], generator: torch.Generator
    ) -> _Splats:
        triangle, barycentric = spread_points(rest, faces, self.config.num_points, generator)
        corners = faces[triangle]

        def at_points(values: Float[Tensor, "V *c"]) -> Float[Tensor, "N *c"]:
            flat = interpolated(values.flatten(1)[None], corners, barycentric)[0]
            return flat.unflatten(1, values.shape[1:])

        config = self.config
        shown = num_coefficients(min(config.sh_degree, config.basis_sh_degree))
        bases = ExpressionBases.of_head(
            self.head, self.identity, faces, at_points, config.num_bases, shown
        )
        weights = torch.from_numpy(self.head.arrays.skinning_weights.copy()).to(rest)
        return _Splats(at_points(rest), at_points(weights), config, bases)

    def _teeth(
        self,
        rest: Float[Tensor, "V 3"],
        faces_of: Mapping[int, Bool[Tensor, "F"]],
        generator: torch.Generator,
    ) -> _Splats | None:
        """Rigidly with one bone each; None for a head without any."""
        count = max(_FEWEST_POINTS, self.config.num_points // 10)
        places, bones = [], []
        for bone, among in faces_of.items():
            faces = self.head.faces[among]
            if len(faces):
                triangle, barycentric = spread_points(rest, faces, count, generator)
                places.append((rest[faces[triangle]] * barycentric[..., None]).sum(1))
                bones.append(torch.eye(5).to(rest)[bone].expand(count, -1))
        if not places:
            return None
        return _Splats(torch.cat(places), torch.cat(bones), self.config)

    @property
    def _parts(self) -> list[_Splats]:
        return [self.face] if self.teeth is None else [self.face, self.teeth]

    @property
    def num_gaussians(self) -> int:
        """The number N of Gaussians: of the face, then of the teeth."""
        return sum(part.rows.count for part in self._parts)

    def gaussians(
        self, theta: Float[Tensor, "B H"], *, cameras: PinholeCameras | None = None
    ) -> GaussianSet:
        """Return theta's Gaussians, the face's before the teeth's; see `AvatarMethod.gaussians`."""
        theta = self.checked(theta)
        weights = basis_weights(self.head, theta)
        transforms = self.head.joint_transforms(theta, self.identity)
        degree = 0 if cameras is None else self._shown.now
        sets = []
        for part in self._parts:
            frames = skinning_frames(part.skinning, transforms)
            found = part.at_rest(weights, degree)
            means, quats, scales = carried(*found[:3], frames)
            directions = torch.zeros_like(means)
            if degree and cameras is not None:
                turned = quat_wxyz_to_matrix(frames.quat_wxyz)
                directions = directions_in_frames(view_directions(means, cameras), turned)
            colors = sh_colors(found.color, directions, degree)
            opacities = torch.sigmoid(found.opacity_logit).expand(len(theta), -1)
            sets.append((means, quats, scales.expand(len(theta), -1, -1), opacities, colors))
        return GaussianSet(*(torch.cat(pieces, 1) for pieces in zip(*sets)))

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return what is trained, of face and teeth alike, by the names in `learning_rates`."""
        groups: dict[str, list[nn.Parameter]] = {}
        for part in self._parts:
            for name, parameter in part.named_parameters():
                group = name.replace("bases.", "basis_")
                groups.setdefault(group, []).append(parameter)
        return groups

    def learning_rates(self) -> dict[str, float]:
        """Return the release's: positions in metres, bases a unit of expression."""
        return {
            "position": 1.6e-4,
            "rotation_wxyz": 1e-3,
            "log_scale": 5e-3,
            "opacity_logit": 0.05,
            "color": 2.5e-3,
            "color_rest": 1.25e-4,
            "basis_position": 3.2e-7,
            "basis_rotation_wxyz": 1e-4,
            "basis_log_scale": 5e-4,
            "basis_opacity_logit": 5e-5,
            "basis_color": 1.25e-3,
        }

    def rate_factors(self, step: int) -> dict[str, float]:
        """Positions' falls exponentially."""
        return {"position": 0.01 ** min(step / self.config.position_decay_steps, 1.0)}

    def image_losses(self, drawn: DrawnBatch, filmed: FilmedBatch, step: int) -> Losses:
        """.8 L1 + .2 DSSIM + 10 times the squared difference of opacity and matte."""
        config, unfilmed = self.config, filmed.unfilmed
        covered = coverage_loss(drawn.alpha, filmed.matte[..., 0], ~unfilmed)
        losses = {"l1": (1 - config.dssim_weight) * l1_loss(drawn.image, filmed.target)}
        if config.dssim_weight > 0:
            held = held_where(drawn.image, unfilmed)
            losses["dssim"] = config.dssim_weight * dssim_loss(held, filmed.target)
        return losses | {"coverage": config.coverage_weight * covered}

    def penalty(self, drawn: DrawnBatch, step: int) -> Losses:
        """100 times how far each row of teeth, at rest, is outside of the mouth's cylinder."""
        if self.teeth is None:
            return {}
        size = (self.mouth_centre, self.mouth_radius_m, self.mouth_half_height_m)
        upper = self.teeth.skinning[:, NECK] > 0.5
        rows = [self.teeth.position[row] for row in (upper, ~upper)]
        terms = [cylinder_term(row, *size) for row in rows if len(row)]
        return {"mouth": self.config.mouth_weight * torch.stack(terms).sum()}

    def watches(self, step: int) -> bool:
        """As density control does."""
        return self.config.density.watches(step)

    def after_step(
        self,
        watched: WatchedStep | None,
        optimizers: Sequence[torch.optim.Optimizer],
        step: int,
        seed: int,
    ) -> Mapping[str, float]:
        """Note where face and teeth have too few Gaussians; the degree of colours grows."""
        if watched is not None:
            self._note(watched)
        if (step + 1) % self.config.sh_degree_every == 0:
            self._shown.set(min(self._shown.now + 1, self.config.sh_degree))
        return {}

    def _note(self, watched: WatchedStep) -> None:
        cameras, counts = watched.cameras, [part.rows.count for part in self._parts]
        gradients = watched.screen_gradient_px.split(counts, 1)
        shown = cameras.shows(watched.gaussians.means.detach()).split(counts, 1)
        for part, gradient, drawn in zip(self._parts, gradients, shown):
            part.statistics.add(gradient, cameras.width, cameras.height, drawn)

    def before_next_step(
        self, optimizers: Sequence[torch.optim.Optimizer], step: int, seed: int
    ) -> Mapping[str, float]:
        """Density control of face and teeth, each by its threshold."""
        face = self.config.density
        teeth = replace(face, gradient_threshold=self.config.teeth_gradient_threshold)
        figures: dict[str, float] = {}
        for part, options, name in zip(self._parts, (face, teeth), ("face", "teeth")):
            changes = control(part.controlled(), options, optimizers, step=step, seed=seed)
            if changes is not None:
                figures[f"{name}_gaussians"] = float(changes.count)
        return figures

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "GaussianBlendshapes":
        """Build an untrained avatar of the same make; `fit_to` then gives it its Gaussians."""
        config = GaussianBlendshapesConfig.from_json(state["config"])
        head = HeadModel(HeadArrays.from_state(state["head"]))
        avatar = cls(head, state["identity"], replace(config, num_points=_FEWEST_POINTS))
        avatar.config = config
        return avatar

    def fit_to(self, parameters: Mapping[str, Any], prefix: str = "") -> None:
        """Make room for as many Gaussians as were stored; raises UserError where they differ."""
        self.face.rows.fit_to(parameters, f"{prefix}face.")
        if self.teeth is not None:
            self.teeth.rows.fit_to(parameters, f"{prefix}teeth.")
