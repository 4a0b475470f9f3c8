"""A GaussianAvatars-style method: a Gaussian a triangle, which carries it by an edge, and more.

Paper: Qian et al., "GaussianAvatars: Photorealistic Head Avatars with Rigged 3D Gaussians", CVPR
2024. Facts are from its release: arguments/__init__.py, train.py, scene/gaussian_model.py,
scene/flame_gaussian_model.py.

Of what it does is here: a Gaussian in the middle of each triangle at first, as large as it, with
opacity .1 and no colour, teeth included where the head has them (FLAME with
`head.teeth.with_teeth(arrays, "blocks")` has the release's 168 triangles); frames from an edge, by
whose size places and scales are multiplied; harmonics up to degree 3 in the world's axes, raised
every 1,000 steps; .8 L1 + .2 DSSIM and the hinges of place and scale, over Gaussians in view; the
learning rates, that of places falling over 600,000 steps; density control from 10,000 steps on,
which keeps a Gaussian on each triangle; one image a step.

The tracked parameters are learnt too there, with Adam at 1e-3 (expressions), 1e-5 (pose) and 1e-6
(translation): here any method has this by `refine_tracking`, whose rates are its own.

Different here: the extent that the places' rate and density control's bounds are multiplied by is
given (there the spread of the cameras, 0 for one that stands still); sizes that density control
compares are those at rest (there in the frame of the moment); children of a split lie around their
parent, as the paper says (there around the middle of the triangle); backgrounds are random colours,
so that opacities are not reset at 10,000 steps as with a white one. Left out: the terms whose
weight is 0 there (offsets of vertices, Laplacian).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.config import MethodConfig
from rgbavatar_ns.avatar.method import DrawnBatch, FilmedBatch, Losses, WatchedStep
from rgbavatar_ns.avatar.methods.carriers import edge_frames
from rgbavatar_ns.avatar.methods.density import DensityControl, sampled_positions
from rgbavatar_ns.avatar.methods.loss_terms import (
    dssim_loss,
    held_where,
    position_hinge,
    scale_hinge,
)
from rgbavatar_ns.avatar.methods.mesh_splats import MeshSplats
from rgbavatar_ns.avatar.methods.sh import (
    MAX_DEGREE,
    ShownDegree,
    num_coefficients,
    shown_colors,
)
from rgbavatar_ns.avatar.model.image_loss import l1_loss
from rgbavatar_ns.avatar.model.tangent_to_world import carried
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.options import Between, Count, Share, Weight

LEARNING_RATES: dict[str, float] = {
    "position": 5e-3,
    "rotation": 0.001,
    "log_scale": 0.017,
    "opacity": 0.05,
    "color": 0.0025,
    "color_rest": 0.0025 / 20,
}
"""Adam's learning rate of each parameter group, that of places a metre of extent."""


@dataclass(frozen=True)
class GaussianAvatarsConfig(MethodConfig):
    """GaussianAvatars' choices; defaults are its release's."""

    initial_opacity: Annotated[float, Between(0, 1, open=True)] = 0.1
    """Opacity of every Gaussian at first."""
    sh_degree: Annotated[int, Between(0, MAX_DEGREE)] = 3
    """Degree of the harmonics that colours follow the view with."""
    raise_degree_every: Count = 1000
    """Steps after which one more degree counts, from 0 on."""
    dssim_weight: Share = 0.2
    """Weight of DSSIM; that of L1 is what is left of 1."""
    position_weight: Weight = 0.01
    """Weight of how far Gaussians are farther from their triangle's middle than `farthest`."""
    farthest: Weight = 1.0
    """In sizes of the triangle."""
    scale_weight: Weight = 1.0
    """Weight of how far scales are larger than `largest`."""
    largest: Weight = 0.6
    """In sizes of the triangle."""
    last_position_rate: Share = 0.01
    """What the learning rate of places falls to, as a share of the first."""
    position_rate_steps: Count = 600_000
    """Steps until it has."""
    density: DensityControl = field(
        default_factory=lambda: DensityControl(
            from_step=10_000,
            until_step=600_000,
            every=2000,
            largest_scale_from_step=60_000,
            reset_every=60_000,
            keep_one_per_face=True,
        )
    )
    """When and where Gaussians are added and removed; its `extent_m` multiplies the rate of places
    too."""


class GaussianAvatars(MeshSplats):
    """Gaussians that keep their place, turn and size within their triangle's frame.

    x = k R x_l + c, q = R q_l, s = k s_l, with `edge_frames`; theta moves nothing beside the mesh.

    Args:
        head: the head model; each of its triangles carries Gaussians.
        identity: the subject's identity coefficients, fixed.
        config: schedules, weights and density control.
        seed: of nothing: what is drawn is drawn in training, by its own seed.
    """

    method = "gaussianavatars-style"
    config_type = GaussianAvatarsConfig
    config: GaussianAvatarsConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    degree_now: Int[Tensor, ""]
    _face_size_m: Float[Tensor, "F"]

    def __init__(
        self,
        head: HeadModel,
        identity: Float[Tensor, "I"],
        config: GaussianAvatarsConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        config = GaussianAvatarsConfig() if config is None else config
        super().__init__(head, identity, config, config.density)
        count = len(head.faces)
        faces = torch.arange(count, device=identity.device)
        self.position = nn.Parameter(identity.new_zeros(count, 3))
        self._make_gaussians(faces, identity.new_zeros(count), config.initial_opacity)
        self._shown = ShownDegree(self, "degree_now", config.sh_degree)
        with torch.no_grad():
            rest = head(identity.new_zeros(1, self.layout.size), identity)
            size_m = edge_frames(rest, head.faces, self.face_index).length_ratio
        assert size_m is not None
        self.register_buffer("_face_size_m", size_m[0], persistent=False)
        others = num_coefficients(config.sh_degree) - 1
        self.color_rest = nn.Parameter(identity.new_zeros(count, others, 3))
        self._keep_rows("position", "color_rest")

    def gaussians(
        self, theta: Float[Tensor, "B H"], *, cameras: PinholeCameras | None = None
    ) -> GaussianSet:
        """Return theta's Gaussians in the head's world; without cameras, with degree 0 alone."""
        vertices = self.head(self.checked(theta), self.identity)
        frames = edge_frames(vertices, self.head.faces, self.face_index)
        means, quats_wxyz, scales = carried(
            self.position[None], self.rotation_wxyz[None], self.log_scale[None], frames
        )
        return GaussianSet(
            means=means,
            quats_wxyz=quats_wxyz,
            scales=scales,
            opacities=torch.sigmoid(self.opacity_logit)[None],
            colors=shown_colors(self.color, self.color_rest, self._shown, means, cameras),
        )

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return what is trained, by the names in `LEARNING_RATES`."""
        groups = {
            "position": [self.position],
            "rotation": [self.rotation_wxyz],
            "log_scale": [self.log_scale],
            "opacity": [self.opacity_logit],
            "color": [self.color],
        }
        if self.config.sh_degree > 0:
            groups["color_rest"] = [self.color_rest]
        return groups

    def learning_rates(self) -> dict[str, float]:
        """Return the release's, for the extent of this head."""
        extent_m = self.config.density.extent_m
        return LEARNING_RATES | {"position": LEARNING_RATES["position"] * extent_m}

    def rate_factors(self, step: int) -> dict[str, float]:
        """Return how far the rate of places has fallen, exponentially (arguments/__init__.py)."""
        share = min((step + 1) / self.config.position_rate_steps, 1.0)
        return {"position": self.config.last_position_rate**share}

    def image_losses(self, drawn: DrawnBatch, filmed: FilmedBatch, step: int) -> Losses:
        """L1 and DSSIM by their weights (train.py)."""
        weight = self.config.dssim_weight
        losses = {"l1": (1 - weight) * l1_loss(drawn.image, filmed.target)}
        if weight > 0:
            shown = held_where(drawn.image, filmed.unfilmed)
            losses["dssim"] = weight * dssim_loss(shown, filmed.target)
        return losses

    def penalty(self, drawn: DrawnBatch, step: int) -> Losses:
        """The hinges of places and scales, in their triangles' sizes, of Gaussians in view."""
        config = self.config
        seen = drawn.cameras.shows(drawn.gaussians.means.detach()).any(0)
        far = position_hinge(self.position, config.farthest, seen)
        large = scale_hinge(self.log_scale.exp(), config.largest, seen)
        return {"position": config.position_weight * far, "scale": config.scale_weight * large}

    def after_step(
        self,
        watched: WatchedStep | None,
        optimizers: Sequence[torch.optim.Optimizer],
        step: int,
        seed: int,
    ) -> Mapping[str, float]:
        """Note where Gaussians are too few; raise the degree of the harmonics where that is due."""
        self._shown.raise_by(step, self.config.raise_degree_every)
        return super().after_step(watched, optimizers, step, seed)

    def _scale_m(self) -> Float[Tensor, "N 3"]:
        return self.log_scale.detach().exp() * self._face_size_m[self.face_index][:, None]

    def _children(
        self, chosen: Int[Tensor, "M"], samples: Float[Tensor, "M S 3"]
    ) -> dict[str, Tensor]:
        scale = self.log_scale[chosen].exp()
        place = sampled_positions(self.position[chosen], self.rotation_wxyz[chosen], scale, samples)
        return {"position": place}
