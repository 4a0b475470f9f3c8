"""A FlashAvatar-style method: Gaussians on the mesh's UV map, moved by a network.

Paper: Xiang et al., "FlashAvatar: High-fidelity Head Avatar with Efficient Gaussian Embedding",
CVPR 2024. Facts are from its release: train.py, arguments/__init__.py, src/deform_model.py,
scene/gaussian_model.py, utils/loss_utils.py.

Of what it does all is here: the UV map of 128 x 128 texels, head and neck alone; opacity .1 and
scales by the nearest neighbours at first; the offset in the head's frame; the MLP of 6 x 256 with
8 octaves of the place at rest, its ten numbers by tanh, scales as log-scale times exp; harmonics up
to degree 3, raised every 500 steps; Huber, 40 times in the mouth; VGG-LPIPS after 15,000 steps, if
asked for; the learning rates; no density control; one image a step.

Different here, because the harness is: backgrounds are random colours (there green); Adam's epsilon
is that of 3DGS for the network too; LPIPS sees the whole picture (there the parsed head), the mouth
is that of the mesh (`hull_mask`; there face parsing); the rim of FLAME's neck is drawn; scales are
found at rest, not in the first frame; the network multiplies bfloat16 where a processor does
(`network_precision`). Its world is the head: here the head moves, so that offsets, rotations and
harmonics turn with the neck's joint, and the network sees the neck's turn too.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.config import MethodConfig
from rgbavatar_ns.avatar.method import AvatarMethod, DrawnBatch, FilmedBatch, Losses
from rgbavatar_ns.avatar.methods.fields import MLP, Precision, positional_encoding
from rgbavatar_ns.avatar.methods.head_regions import MOUTH_GROUPS, group_vertices, hull_mask
from rgbavatar_ns.avatar.methods.loss_terms import held_where, huber_loss
from rgbavatar_ns.avatar.methods.neighbours import neighbour_distance
from rgbavatar_ns.avatar.methods.sh import (
    MAX_DEGREE,
    ShownDegree,
    num_coefficients,
    shown_colors,
)
from rgbavatar_ns.avatar.model.anchors import GaussianAnchors
from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel, ThetaLayout, UVAnchors, uv_anchors
from rgbavatar_ns.head.rotations import matrix_to_quat_wxyz, multiply_quats_wxyz
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.options import Between, Count, Counted, Positive, Weight

LEARNING_RATES: dict[str, float] = {
    "log_scale": 0.005,
    "rotation": 0.001,
    "opacity": 0.05,
    "color": 0.0025,
    "color_rest": 0.0025 / 20,
    "offset_network": 1e-4,
}
"""Adam's learning rate of each parameter group (arguments/__init__.py, src/deform_model.py)."""
_HEAD_MOTION = ("rotation", "translation")
"""Parts of theta that move the head as a whole, of which the network knows nothing."""
_NECK_JOINT = 1
_OFFSET, _TURN, _STRETCH = slice(0, 3), slice(3, 7), slice(7, 10)
"""The network's ten numbers."""


@dataclass(frozen=True)
class FlashAvatarConfig(MethodConfig):
    """FlashAvatar's choices; defaults are its release's."""

    uv_resolution: Annotated[int, Between(1, 4096)] = 128
    """Side of the UV map whose covered texels carry one Gaussian each."""
    hidden_width: Annotated[int, Between(1, 8192)] = 256
    """Width of the offset network's hidden layers."""
    hidden_layers: Annotated[int, Between(1, 100)] = 6
    """How many hidden layers it has."""
    octaves: Annotated[int, Between(0, 30)] = 8
    """Frequencies that encode a Gaussian's place at rest."""
    network_precision: Precision = "auto"
    """Of the network's products (ours): auto is bfloat16 on processors that multiply it, else
    float32, the release's."""
    initial_opacity: Annotated[float, Between(0, 1, open=True)] = 0.1
    """Opacity of every Gaussian at first."""
    sh_degree: Annotated[int, Between(0, MAX_DEGREE)] = 3
    """Degree of the harmonics that colours follow the view with."""
    raise_degree_every: Count = 500
    """Steps after which one more degree counts, from 0 on."""
    huber_delta: Positive = 0.1
    """Difference beyond which the loss grows linearly."""
    mouth_weight: Weight = 40.0
    """How often the mouth's pixels count once more."""
    lpips_weight: Weight = 0.0
    """Weight of LPIPS (release: .05); off, because its network's weights need a download."""
    lpips_from_step: Counted = 15_000
    """Steps without LPIPS."""


class FlashAvatar(AvatarMethod):
    """Gaussians that keep to their places on the mesh but for what a network adds for each theta.

    x = mesh(theta) + R o, q = R (q_0 d), log s = s_0 exp(e), where R turns the head and o (metres),
    d = (exp(d_0), d_1..3) and e are tanh of the network's numbers (src/deform_model.py, `decode`).

    Args:
        head: the head model; what it has below the neck carries nothing.
        identity: the subject's identity coefficients, fixed.
        config: sizes, schedules and weights.
        seed: of the network's initial values; nothing else is random.
    """

    method = "flashavatar-style"
    config_type = FlashAvatarConfig
    config: FlashAvatarConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    place_at_rest: Float[Tensor, "N 3"]
    degree_now: Int[Tensor, ""]
    _mouth: Int[Tensor, "M"]

    def __init__(
        self,
        head: HeadModel,
        identity: Float[Tensor, "I"],
        config: FlashAvatarConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        config = FlashAvatarConfig() if config is None else config
        super().__init__(head, identity, config)
        with torch.no_grad():
            rest = head(identity.new_zeros(self.layout.size), identity)
        anchors = _above_the_torso(head, config.uv_resolution)
        self.anchors = GaussianAnchors(head, anchors, rest, "normalized")
        self.register_buffer("place_at_rest", self.anchors.origins(rest[None])[0].contiguous())
        self._shown = ShownDegree(self, "degree_now", config.sh_degree)
        self.register_buffer("_mouth", group_vertices(head.arrays, MOUTH_GROUPS), persistent=False)
        count, start = len(self.anchors), config.initial_opacity
        log_scale = neighbour_distance(self.place_at_rest).log()
        self.log_scale = nn.Parameter(log_scale[:, None].repeat(1, 3))
        self.rotation_wxyz = nn.Parameter(identity.new_tensor([1.0, 0, 0, 0]).repeat(count, 1))
        self.opacity_logit = nn.Parameter(identity.new_full((count,), start).logit())
        coefficients = num_coefficients(config.sh_degree)
        self.color = nn.Parameter(identity.new_zeros(count, 1, 3))
        self.color_rest = nn.Parameter(identity.new_zeros(count, coefficients - 1, 3))
        self._expression = ThetaLayout(
            tuple(field for field in self.layout.fields if field.name not in _HEAD_MOTION)
        )
        self.offset_network = MLP(
            [3 * (1 + 2 * config.octaves), self._expression.feature_size()],
            config.hidden_width,
            config.hidden_layers,
            _STRETCH.stop,
            generator=torch.Generator().manual_seed(seed),
            precision=config.network_precision,
        ).to(identity)
        self._lpips = LPIPSLoss()

    @property
    def num_gaussians(self) -> int:
        """The number N of Gaussians."""
        return len(self.anchors)

    def offsets(self, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B N 10"]:
        """Offset in metres, turn and stretch of each Gaussian, all in (-1, 1)."""
        parts = self.layout.split(theta)
        shown = self._expression.join({name: parts[name] for name in self._expression.names})
        code = positional_encoding(self.place_at_rest, self.config.octaves)[None]
        return torch.tanh(
            self.offset_network(code, self._expression.network_features(shown)[:, None])
        )

    def gaussians(
        self, theta: Float[Tensor, "B H"], *, cameras: PinholeCameras | None = None
    ) -> GaussianSet:
        """Return theta's Gaussians in the head's world; without cameras, with degree 0 alone."""
        theta = self.checked(theta)
        vertices = self.head(theta, self.identity)
        turn = self.head.joint_transforms(theta, self.identity)[:, _NECK_JOINT, :3, :3]
        numbers = self.offsets(theta)
        means = self.anchors.origins(vertices) + numbers[..., _OFFSET] @ turn.mT
        first, rest = numbers[..., _TURN].split([1, 3], -1)
        quats_wxyz = multiply_quats_wxyz(self.rotation_wxyz, torch.cat([first.exp(), rest], -1))
        turn_wxyz = matrix_to_quat_wxyz(turn)[:, None]
        turns = turn[:, None].expand(-1, len(self.color), -1, -1)
        log_scale = self.log_scale * numbers[..., _STRETCH].exp()
        return GaussianSet(
            means=means,
            quats_wxyz=multiply_quats_wxyz(turn_wxyz, quats_wxyz),
            scales=log_scale.exp(),
            opacities=torch.sigmoid(self.opacity_logit)[None],
            colors=shown_colors(self.color, self.color_rest, self._shown, means, cameras, turns),
        )

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return what is trained, by the names in `LEARNING_RATES`."""
        groups = {
            "log_scale": [self.log_scale],
            "rotation": [self.rotation_wxyz],
            "opacity": [self.opacity_logit],
            "color": [self.color],
            "offset_network": list(self.offset_network.parameters()),
        }
        if self.config.sh_degree > 0:
            groups["color_rest"] = [self.color_rest]
        return groups

    def learning_rates(self) -> dict[str, float]:
        """Return the release's."""
        return LEARNING_RATES

    def image_losses(self, drawn: DrawnBatch, filmed: FilmedBatch, step: int) -> Losses:
        """Huber's loss, once more in the mouth, and LPIPS where it counts (train.py)."""
        delta, weight = self.config.huber_delta, self.config.mouth_weight
        losses = {"huber": huber_loss(drawn.image, filmed.target, delta)}
        if weight > 0 and len(self._mouth):
            with torch.no_grad():
                inside = self.head(drawn.theta, self.identity)[:, self._mouth]
            mouth = hull_mask(inside, drawn.cameras)
            losses["mouth"] = weight * huber_loss(drawn.image, filmed.target, delta, mouth)
        if self.config.lpips_weight > 0 and step >= self.config.lpips_from_step:
            # The network looks around a pixel: what nobody filmed is the same in both, and fixed.
            shown = held_where(drawn.image, filmed.unfilmed)
            losses["lpips"] = self.config.lpips_weight * self._lpips(shown, filmed.target)
        return losses

    def after_step(self, watched: Any, optimizers: Any, step: int, seed: int) -> dict[str, float]:
        """Raise the degree of the harmonics where that is due."""
        self._shown.raise_by(step, self.config.raise_degree_every)
        return {}


def _above_the_torso(head: HeadModel, resolution: int) -> UVAnchors:
    """The texels of head and neck; UserError where there is none."""
    found = uv_anchors(head.uv, head.uv_faces, resolution)
    below = torch.zeros(len(head.arrays.v_template), dtype=torch.bool)
    below[group_vertices(head.arrays, ("torso",))] = True
    chosen = ~below[head.faces.cpu()].any(1)[found.triangle_index.cpu()]
    if not bool(chosen.any()):
        raise UserError(
            f"No texel of a UV map of {resolution} x {resolution} lies on the head.",
            "Give a larger uv_resolution.",
        )
    return UVAnchors(
        found.triangle_index[chosen],
        found.barycentric[chosen],
        found.texel_row_col[chosen],
        resolution,
    )
