"""A SplattingAvatar-style method: Gaussians that walk over the mesh as they learn.

Paper: Shao et al., "SplattingAvatar: Realistic Real-Time Human Avatars with Mesh-Embedded Gaussian
Splatting", CVPR 2024. Facts are from its release: configs/splatting_avatar.yaml,
model/splatting_avatar_model.py, model/splatting_avatar_optim.py, model/loss_base.py, utils/map.py,
utils/data_utils.py. Its head is four times as large as in metres; lengths and their rates are
divided by 4 here.

Of what it does is here: 10,000 random places at first, grey, opacity .1, scales by the nearest
neighbours; barycentric coordinates and an offset along the interpolated normal, rotations by the
vertices' quaternions, log-scales times the change of area; colours without harmonics; L1 + 10 MSE,
.01 LPIPS if asked for, and the mean of the spikes' largest scales; the learning rates, those of
places falling a hundredfold over 30,000 steps; density control from step 600 to 29,000 with an
extent of 2 (half a metre), opacities reset every 3,000; the walk over triangles every 100; one
image a step.

Another version of its configuration (commit 1daab1a) has .2 DSSIM with .8 L1, LPIPS .05, no term of
spikes for heads, and density control up to 15,000: `dssim_weight`, `lpips_weight`, `spike_weight`
and `density` say that too.

Different here: triangles are drawn by area (there each as often as the others: `by_area`); the mesh
at rest is that of theta 0 (there the first frame's); a way over several triangles is straight; the
u and v of a place learn by the picture, as the paper says (in the release's code nothing drawn
depends on them, and only children of a split are placed anew); children of a split walk as far as
they were drawn along the surface (there to the nearest point of it); sizes that density control
compares are those at rest; at the most Gaussians, those of the largest gradient go first.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.config import MethodConfig
from rgbavatar_ns.avatar.method import DrawnBatch, FilmedBatch, Losses
from rgbavatar_ns.avatar.methods.carriers import SmoothSurface
from rgbavatar_ns.avatar.methods.density import DensityControl, sampled_positions
from rgbavatar_ns.avatar.methods.gaussian_rows import forget_moments
from rgbavatar_ns.avatar.methods.loss_terms import dssim_loss, held_where, mse_loss, spike_term
from rgbavatar_ns.avatar.methods.mesh_splats import MeshSplats
from rgbavatar_ns.avatar.methods.neighbours import neighbour_distance
from rgbavatar_ns.avatar.methods.sh import sh_colors
from rgbavatar_ns.avatar.methods.triangle_walk import TriangleWalk
from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss, l1_loss
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.surface import interpolated
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.options import Between, Count, Positive, Share, Weight

_UNITS_PER_M = 4.0
"""Of the release's lengths."""
LEARNING_RATES: dict[str, float] = {
    "place": 1.6e-4,
    "offset": 1.6e-4 / _UNITS_PER_M,
    "rotation": 0.001,
    "log_scale": 0.005,
    "opacity": 0.05,
    "color": 0.0025,
}
"""Adam's learning rate of each parameter group; that of offsets is in metres."""
_LEAST_SCALE_M = math.sqrt(1e-7) / _UNITS_PER_M


@dataclass(frozen=True)
class SplattingAvatarConfig(MethodConfig):
    """SplattingAvatar's choices; defaults are its release's."""

    initial_count: Count = 10_000
    """How many Gaussians there are at first."""
    by_area: bool = True
    """Whether large triangles get more of them: ours. Without, each as many (release)."""
    area_changes_scale: bool = True
    """Whether log-scales are multiplied by how triangles have grown (release: yes)."""
    initial_opacity: Annotated[float, Between(0, 1, open=True)] = 0.1
    """Opacity of every Gaussian at first."""
    mse_weight: Weight = 10.0
    """Weight of the mean squared difference."""
    dssim_weight: Share = 0.0
    """Weight of DSSIM; that of L1 is what is left of 1."""
    lpips_weight: Weight = 0.0
    """Weight of LPIPS (release: .01); off, because its network's weights need a download."""
    spike_weight: Weight = 1.0
    """Weight of the spikes' largest scales, in quarters of a metre."""
    spike_from_m: Weight = 0.002
    """Scale above which a Gaussian may be a spike."""
    spike_ratio: Positive = 10.0
    """How much larger than its smallest scale a spike's largest one is."""
    last_place_rate: Share = 0.01
    """What the learning rate of places and offsets falls to, as a share of the first."""
    place_rate_steps: Count = 30_000
    """Steps until it has."""
    walk_every: Count = 100
    """Steps between two walks over the triangles."""
    density: DensityControl = field(
        default_factory=lambda: DensityControl(
            from_step=500, until_step=29_000, extent_m=2 / _UNITS_PER_M, max_count=150_000
        )
    )
    """When and where Gaussians are added and removed."""


class SplattingAvatar(MeshSplats):
    """Gaussians at places of a smooth surface, off it along its normal, turned as it turns.

    x = p(u, v) + d n(u, v), q = q(u, v) q_0, log s = r log s_0 in the release's units, where r is
    how the triangle's area has grown (utils/map.py), or 1: what is below a quarter of a metre
    shrinks as its triangle grows.

    Args:
        head: the head model; any of its triangles carries Gaussians.
        identity: the subject's identity coefficients, fixed.
        config: sizes, schedules, weights and density control.
        seed: of the places at first; what is drawn in training has its own.
    """

    method = "splattingavatar-style"
    config_type = SplattingAvatarConfig
    config: SplattingAvatarConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    barycentric: Float[Tensor, "N 3"]
    _rest_vertices: Float[Tensor, "V 3"]

    def __init__(
        self,
        head: HeadModel,
        identity: Float[Tensor, "I"],
        config: SplattingAvatarConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        config = SplattingAvatarConfig() if config is None else config
        super().__init__(head, identity, config, config.density)
        with torch.no_grad():
            rest = head(identity.new_zeros(self.layout.size), identity)
        self.register_buffer("_rest_vertices", rest, persistent=False)
        self.surface = SmoothSurface(rest, head.faces)
        corners = rest[head.faces].detach().cpu()
        places = random_places(corners, config.initial_count, seed, by_area=config.by_area)
        face_index, barycentric = (part.to(identity.device) for part in places)
        at = interpolated(rest[None], head.faces[face_index], barycentric)[0]
        log_scale = neighbour_distance(at, _LEAST_SCALE_M).log()
        self.register_buffer("barycentric", barycentric)
        self.place = nn.Parameter(identity.new_zeros(config.initial_count, 2))
        self.offset_m = nn.Parameter(identity.new_zeros(config.initial_count))
        self._make_gaussians(face_index, log_scale, config.initial_opacity)
        self._keep_rows("place", "offset_m", "barycentric")
        self._lpips = LPIPSLoss()

    def gaussians(
        self, theta: Float[Tensor, "B H"], *, cameras: PinholeCameras | None = None
    ) -> GaussianSet:
        """Return theta's Gaussians in the head's world; the same for all cameras."""
        vertices = self.head(self.checked(theta), self.identity)
        places = self.barycentric + self._change()
        surface = self.surface.frames(vertices, self.face_index, places)
        means = surface.means(self.offset_m[None])
        log_scale, unit = self.log_scale[None], math.log(_UNITS_PER_M)
        if self.config.area_changes_scale:
            log_scale = (log_scale + unit) * surface.area_ratio[..., None] - unit
        return GaussianSet(
            means=means,
            quats_wxyz=surface.turned(self.rotation_wxyz[None]),
            scales=log_scale.exp(),
            opacities=torch.sigmoid(self.opacity_logit)[None],
            colors=sh_colors(self.color, means[:1], 0),
        )

    def _change(self) -> Float[Tensor, "N 3"]:
        """How the barycentric coordinates have changed since the last walk."""
        return torch.cat([self.place, -self.place.sum(1, keepdim=True)], 1)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return what is trained, by the names in `LEARNING_RATES`."""
        return {
            "place": [self.place],
            "offset": [self.offset_m],
            "rotation": [self.rotation_wxyz],
            "log_scale": [self.log_scale],
            "opacity": [self.opacity_logit],
            "color": [self.color],
        }

    def learning_rates(self) -> dict[str, float]:
        """Return the release's."""
        return LEARNING_RATES

    def rate_factors(self, step: int) -> dict[str, float]:
        """Return how far the rates of places and offsets have fallen, exponentially."""
        share = min((step + 1) / self.config.place_rate_steps, 1.0)
        return dict.fromkeys(("place", "offset"), self.config.last_place_rate**share)

    def image_losses(self, drawn: DrawnBatch, filmed: FilmedBatch, step: int) -> Losses:
        """L1, the squared difference, and DSSIM and LPIPS where they count (loss_base.py)."""
        config, image, target = self.config, drawn.image, filmed.target
        losses = {
            "l1": (1 - config.dssim_weight) * l1_loss(image, target),
            "mse": config.mse_weight * mse_loss(image, target),
        }
        shown = held_where(image, filmed.unfilmed)
        if config.dssim_weight > 0:
            losses["dssim"] = config.dssim_weight * dssim_loss(shown, target)
        if config.lpips_weight > 0:
            losses["lpips"] = config.lpips_weight * self._lpips(shown, target)
        return losses

    def penalty(self, drawn: DrawnBatch, step: int) -> Losses:
        """The mean of the spikes' largest scales, in the release's unit (loss_base.py)."""
        config = self.config
        if config.spike_weight == 0:
            return {}
        spikes = spike_term(drawn.gaussians.scales, config.spike_from_m, config.spike_ratio)
        return {"spikes": config.spike_weight * _UNITS_PER_M * spikes}

    def before_next_step(
        self, optimizers: Sequence[torch.optim.Optimizer], step: int, seed: int
    ) -> Mapping[str, float]:
        """Walk over the triangles, add and remove Gaussians, where that is due."""
        if (step + 1) % self.config.walk_every == 0:
            self._walk(optimizers)
        return super().before_next_step(optimizers, step, seed)

    def _scale_m(self) -> Float[Tensor, "N 3"]:
        return self.log_scale.detach().exp()

    @torch.no_grad()
    def _walk(self, optimizers: Sequence[torch.optim.Optimizer]) -> None:
        """Go where the coordinates have changed to, and let them begin anew from there."""
        walk = TriangleWalk(self._rest_vertices, self.head.faces)
        face_index, barycentric = walk(self.face_index, self.barycentric, self._change())
        self.face_index.copy_(face_index)
        self.barycentric.copy_(barycentric)
        self.place.zero_()
        forget_moments(self.place, optimizers)

    def _children(
        self, chosen: Int[Tensor, "M"], samples: Float[Tensor, "M S 3"]
    ) -> dict[str, Tensor]:
        """Where samples around the parents lie when they have walked there over the surface."""
        faces = self.head.faces
        rotation_wxyz, scale = self.rotation_wxyz[chosen], self.log_scale[chosen].exp()
        way_m = sampled_positions(scale.new_zeros(len(chosen), 3), rotation_wxyz, scale, samples)
        parent = self.face_index[chosen]
        change = barycentric_change(self._rest_vertices[faces[parent]], way_m)
        change = change + self._change()[chosen, None]
        count = samples.shape[1]
        face_index, barycentric = TriangleWalk(self._rest_vertices, faces)(
            parent.repeat_interleave(count),
            self.barycentric[chosen].repeat_interleave(count, 0),
            change.flatten(0, 1),
        )
        return {
            "face_index": face_index.unflatten(0, (-1, count)),
            "barycentric": barycentric.unflatten(0, (-1, count)),
            "place": samples.new_zeros(*samples.shape[:2], 2),
        }


def random_places(
    corners: Float[Tensor, "F 3 3"], count: int, seed: int, *, by_area: bool
) -> tuple[Int[Tensor, "N"], Float[Tensor, "N 3"]]:
    """Triangles and barycentric coordinates, uniform within triangles, that `seed` decides.

    Triangles are drawn as often as they are large, or each as often as the others.
    """
    generator = torch.Generator().manual_seed(seed)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = torch.linalg.cross(first, second).norm(dim=1)
    weight = area if by_area else torch.ones_like(area)
    face_index = torch.multinomial(weight, count, replacement=True, generator=generator)
    # The gaps that two numbers leave in [0, 1].
    cuts = torch.rand(count, 2, generator=generator, dtype=corners.dtype).sort(1).values
    ends = torch.cat([torch.zeros(count, 1), cuts, torch.ones(count, 1)], 1).to(corners)
    return face_index, ends.diff(dim=1)


def barycentric_change(
    corners: Float[Tensor, "M 3 3"], way: Float[Tensor, "M S 3"]
) -> Float[Tensor, "M S 3"]:
    """How coordinates change along ways, of which the part in the triangle's plane counts.

    Nothing changes in triangles without area.
    """
    edges = corners[:, 1:] - corners[:, :1]
    gram = (edges @ edges.mT).double()
    (a, b), (_, c) = (row.unbind(1) for row in gram.unbind(1))
    area = a * c - b * b
    flat = area <= 1e-12 * (a + c) ** 2
    inverse = torch.stack([c, -b, -b, a], 1).unflatten(1, (2, 2))
    inverse = inverse / torch.where(flat, torch.inf, area)[:, None, None]
    along = ((way @ edges.mT).double() @ inverse).to(way)
    return torch.cat([-along.sum(-1, keepdim=True), along], -1)
