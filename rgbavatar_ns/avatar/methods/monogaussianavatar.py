"""A MonoGaussianAvatar-style method: points in a canonical space, deformed by learned blendshapes.

Paper: Chen et al., "MonoGaussianAvatar: Monocular Gaussian Point-based Head Avatar", SIGGRAPH 2024.
Facts are from its release: code/confs/subject1.conf, code/model/ (monogaussian_avatar_model.py,
geometry_network.py, gaussian_network.py, point_cloud.py, loss.py), code/scripts/train.py; the
deformer is PointAvatar's (Zheng et al. 2023, code/model/deformer_network.py). Its head is four
times as large as one in metres: lengths are divided by 4 here, networks take and give its units.

Of what it does all is here: 400 points on a sphere; the deformer of 4 x 128, which gives a point
its offset, expressions, pose correctives and the weights of six bones; attributes by an MLP of
7 x 256 with 6 octaves, offsets of them by one of 3 x 64 of how far a point has moved, each with a
hidden layer for every attribute; RGB; the radius that all scales have beside; L1, .25 DSSIM and, if
asked for, LPIPS-VGG (there VGG features); the terms that hold the deformer to the head model,
halved at epochs; each epoch points below opacity .1 removed and refilled up to 100,000; the
learning rate, halved at epochs 80 and 100 (in the release the optimiser that begins anew each epoch
forgets that; here Adam's moments of points that stay go on).

Left out: learning theta of the frames, which the harness's refinement does for any method alike;
the variance of the film's expressions, which a method does not know, in the expressions' term (1/50
stands for it); canonical jaw and expression, which are those at rest here; weight normalisation;
initial values of a signed distance (He's here); batches that shrink as points grow, which is the
preset's; white backgrounds (random colours here). Rotations are the networks' alone, as there:
bones move points, but do not turn what is drawn there. Networks of attributes multiply bfloat16
where a processor does (`network_precision`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor, nn

from rgbavatar_ns.avatar.config import MethodConfig
from rgbavatar_ns.avatar.method import AvatarMethod, DrawnBatch, FilmedBatch, Losses, WatchedStep
from rgbavatar_ns.avatar.methods.density import prune_and_refill
from rgbavatar_ns.avatar.methods.fields import MLP, Precision, positional_encoding, sharp_softplus
from rgbavatar_ns.avatar.methods.gaussian_rows import GaussianRows
from rgbavatar_ns.avatar.methods.loss_terms import dssim_loss, held_where
from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss, l1_loss
from rgbavatar_ns.avatar.model.weight_network import seeded_linear
from rgbavatar_ns.head import HeadArrays, HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.options import Between, Count, Positive, Share, Weight

LEARNING_RATE = 1e-4
"""Adam's, of points and networks alike (subject1.conf)."""
_UNIT = 4.0
"""Length of the release's units in a metre."""
_POINTS = {
    **{0: 400, 5: 800, 10: 1600, 15: 3200, 20: 6400},
    **{25: 10_000, 30: 20_000, 40: 40_000, 50: 80_000, 60: 100_000},
}
"""Points from an epoch on (train.py, `upsample_points`)."""
_RATE_HALVED, _TERMS_HALVED = (80, 100), (20, 30, 50, 70)
"""Epochs, counted from 0."""
_LATE_EPOCH, _LATE_JITTER_M = 100, 0.004 / _UNIT
_ATTRIBUTES = {"color": 3, "scale": 3, "rotation_wxyz": 4, "opacity": 1}
_SHARPNESS = 20.0
"""Of the softmax that gives skinning weights."""
_EXAGGERATED = 10 * _UNIT
"""What blendshapes in metres are multiplied by in their terms (loss.py)."""


@dataclass(frozen=True)
class MonoGaussianAvatarConfig(MethodConfig):
    """MonoGaussianAvatar's choices; defaults are its release's."""

    steps_per_epoch: Count = 500
    """Steps in which the film is seen once, which the release counts its schedules in."""
    max_points: Count = 100_000
    """Most points."""
    initial_radius_m: Positive = 0.5 / _UNIT
    """Radius of the sphere of the first points, around the mesh's middle."""
    largest_scale_m: Positive = 0.025 / _UNIT
    """What the network can add to the radius as standard deviation of a Gaussian."""
    prune_opacity: Share = 0.1
    """Points that no step of an epoch showed as opaque as this are removed."""
    deformer_width: Annotated[int, Between(1, 8192)] = 128
    """Width of the deformer's four hidden layers."""
    attribute_width: Annotated[int, Between(1, 8192)] = 256
    """Width of the seven hidden layers of the attributes."""
    offset_width: Annotated[int, Between(1, 8192)] = 64
    """Width of the three layers of the attributes' offsets."""
    octaves: Annotated[int, Between(0, 30)] = 6
    """Frequencies that encode a point's place for its attributes."""
    network_precision: Precision = "auto"
    """Of the products of attributes and their offsets (ours): auto is bfloat16 on processors that
    multiply it, else float32, the release's. The deformer's are float32."""
    dssim_weight: Weight = 0.25
    """Weight of 1 - SSIM."""
    lpips_weight: Weight = 0.0
    """Weight of LPIPS (release: .1, of VGG features); off, because its network's weights need a
    download."""
    skinning_weight: Weight = 1.0
    """Weight of the term of the skinning weights."""
    pose_weight: Weight = 100.0
    """Weight of the term of the pose correctives."""
    expression_weight: Weight = 100.0
    """Weight of the term of the expressions."""


@dataclass(frozen=True)
class DeformedPoints:
    """What the deformer gives canonical points: metres, and weights that sum to one.

    The bones are one that only theta's translation moves, then the head's joints.
    """

    place_at_rest: Float[Tensor, "N 3"]
    expression_dirs: Float[Tensor, "N E 3"]
    pose_dirs: Float[Tensor, "N P 3"]
    skinning_weights: Float[Tensor, "N J"]


class _Heads(nn.Module):
    """A hidden layer and an output for each attribute."""

    def __init__(self, width: int, **options: Any) -> None:
        super().__init__()
        self.heads = nn.ModuleDict(
            {name: MLP([width], width, 1, size, **options) for name, size in _ATTRIBUTES.items()}
        )

    def forward(self, features: Float[Tensor, "*n C"]) -> dict[str, Float[Tensor, "*n _"]]:
        return {name: head(features) for name, head in self.heads.items()}


class MonoGaussianAvatar(AvatarMethod):
    """Points whose deformation, colour and shape are functions of their place in canonical space.

    Args:
        head: the head model: its joints move the points, its blendshapes are what the points' own
            are held to.
        identity: the subject's identity coefficients, fixed.
        config: sizes, schedules and weights.
        seed: of the first points and the networks' initial values.
    """

    method = "monogaussianavatar-style"
    config_type = MonoGaussianAvatarConfig
    config: MonoGaussianAvatarConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    seen: Bool[Tensor, "N"]
    epoch: Int[Tensor, ""]
    _expressions: Float[Tensor, "V E 3"]
    _correctives: Float[Tensor, "V P 3"]
    _skinning: Float[Tensor, "V J"]

    def __init__(
        self,
        head: HeadModel,
        identity: Float[Tensor, "I"],
        config: MonoGaussianAvatarConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        config = MonoGaussianAvatarConfig() if config is None else config
        super().__init__(head, identity, config)
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            rest = head(identity.new_zeros(self.layout.size), identity)
        self._vertex_tree = KDTree(rest.cpu().numpy())
        self._turned = [f.name for f in self.layout.fields if f.form == "axis_angle"][1:]
        self._blended = [f.name for f in self.layout.fields if f.form == "linear"]
        for name, values in zip(
            ("_expressions", "_correctives", "_skinning"), _head_blendshapes(head.arrays)
        ):
            # Of the directions, what their terms compare.
            scale = 1.0 if name == "_skinning" else _EXAGGERATED
            self.register_buffer(name, scale * values.to(identity), persistent=False)
        count = self.points_of(0)
        around = F.normalize(torch.rand(count, 3, generator=generator) * 2 - 1, dim=-1)
        middle = 0.5 * (rest.amin(0) + rest.amax(0))
        self.position = nn.Parameter(middle + config.initial_radius_m * around.to(identity))
        self.register_buffer("seen", torch.zeros(count, dtype=torch.bool))
        self.register_buffer("epoch", torch.zeros((), dtype=torch.int64))
        self._make_networks(generator)
        self._rows = GaussianRows(self, ("position", "seen"))
        self._lpips = LPIPSLoss()

    def _make_networks(self, generator: torch.Generator) -> None:
        config = self.config
        deformer, wide, narrow = config.deformer_width, config.attribute_width, config.offset_width
        # Their last layer's activation is applied where they are used, before the heads.
        self.deformer = MLP([3], deformer, 3, deformer, generator=generator, activation="softplus")
        directions = 3 * (self._expressions.shape[1] + self._correctives.shape[1] + 1)
        self.blendshapes = seeded_linear(deformer, directions, generator)
        nn.init.zeros_(self.blendshapes.weight)
        nn.init.zeros_(self.blendshapes.bias)
        self.skinning = MLP(
            *([deformer], deformer, 1, self._skinning.shape[1]),
            generator=generator,
            activation="softplus",
            last_scale=0.0,
        )
        code = 3 * (1 + 2 * config.octaves)
        made: dict[str, Any] = {"generator": generator, "precision": config.network_precision}
        self.attributes = MLP([code], wide, 6, wide, skip_at=3, activation="softplus", **made)
        self.attribute_heads = _Heads(wide, activation="softplus", **made)
        self.offsets = MLP([3], narrow, 2, narrow, **made)
        self.offset_heads = _Heads(narrow, **made)
        for network in (self.deformer, self.skinning.hidden, self.attributes):
            _draw_he_normal(network, generator)
        self.to(self.identity)

    @property
    def num_gaussians(self) -> int:
        """The number N of Gaussians."""
        return len(self.position)

    def points_of(self, epoch: int) -> int:
        """How many points there are in an epoch, counted from 0."""
        known = [count for start, count in _POINTS.items() if start <= epoch]
        return min(known[-1], self.config.max_points)

    def deformed(self) -> DeformedPoints:
        """Ask the deformer about every point."""
        features = sharp_softplus(self.deformer(_UNIT * self.position))
        directions = self.blendshapes(features).unflatten(-1, (-1, 3)) / _UNIT
        sizes = (self._expressions.shape[1], self._correctives.shape[1], 1)
        expressions, correctives, offset = directions.split(sizes, 1)
        weights = torch.softmax(_SHARPNESS * self.skinning(features), -1)
        return DeformedPoints(self.position + offset[:, 0], expressions, correctives, weights)

    def gaussians(
        self, theta: Float[Tensor, "B H"], *, cameras: PinholeCameras | None = None
    ) -> GaussianSet:
        """Return theta's Gaussians in the head's world, the same for all cameras."""
        theta = self.checked(theta)
        deformed = self.deformed()
        means = self._posed(deformed, theta)
        # Of the head's motion the release's world has the turns; its translation is the camera's.
        with torch.no_grad():
            moved = means - self._translation(theta)[:, None] - deformed.place_at_rest
        code = positional_encoding(_UNIT * self.position.detach(), self.config.octaves)
        own = self.attribute_heads(sharp_softplus(self.attributes(code)))
        offsets = self.offset_heads(self.offsets(_UNIT * moved))
        found = {name: own[name] + offsets[name] for name in _ATTRIBUTES}
        largest = self.config.largest_scale_m
        return GaussianSet(
            means=means,
            quats_wxyz=found["rotation_wxyz"],
            scales=largest * torch.sigmoid(found["scale"]) + radius_m(int(self.epoch)),
            opacities=torch.sigmoid(found["opacity"][..., 0]),
            colors=torch.sigmoid(found["color"]),
        )

    def _posed(self, points: DeformedPoints, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B N 3"]:
        """Blendshapes, then linear blend skinning (FLAME, with the points' own of both)."""
        parts = self.layout.split(theta)
        shown = torch.cat([parts[name] for name in self._blended], -1)
        turns = axis_angle_to_matrix(torch.stack([parts[name] for name in self._turned], 1))
        turns = (turns - torch.eye(3, dtype=theta.dtype, device=theta.device)).flatten(1)
        directions = torch.cat([points.expression_dirs, points.pose_dirs], 1)
        added = torch.einsum("bk,nkx->bnx", torch.cat([shown, turns], 1), directions)
        joints = self.head.joint_transforms(theta, self.identity)
        still = torch.eye(4, dtype=theta.dtype, device=theta.device).repeat(len(theta), 1, 1, 1)
        still[:, 0, :3, 3] = self._translation(theta)
        bones = torch.cat([still, joints], 1)[:, :, :3].flatten(2)
        blended = (points.skinning_weights @ bones).unflatten(2, (3, 4))
        shaped = points.place_at_rest + added
        return (blended[..., :3] * shaped[:, :, None]).sum(-1) + blended[..., 3]

    def _translation(self, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B 3"]:
        return theta[:, self.layout.slice("translation")]

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return what is trained: the points, and each network."""
        networks = {
            "deformer": (self.deformer, self.blendshapes, self.skinning),
            "attributes": (self.attributes, self.attribute_heads),
            "offsets": (self.offsets, self.offset_heads),
        }
        groups = {"position": [self.position]}
        for name, modules in networks.items():
            groups[name] = [p for module in modules for p in module.parameters()]
        return groups

    def learning_rates(self) -> dict[str, float]:
        """Return the release's, one for all; of points in metres it is a fourth."""
        rates = dict.fromkeys(self.parameter_groups(), LEARNING_RATE)
        return rates | {"position": LEARNING_RATE / _UNIT}

    def rate_factors(self, step: int) -> dict[str, float]:
        """Halve all rates at epochs 80 and 100."""
        factor = _halved(step // self.config.steps_per_epoch, _RATE_HALVED)
        return dict.fromkeys(self.parameter_groups(), factor)

    def image_losses(self, drawn: DrawnBatch, filmed: FilmedBatch, step: int) -> Losses:
        """L1, DSSIM and LPIPS (loss.py)."""
        config = self.config
        losses = {"l1": l1_loss(drawn.image, filmed.target)}
        shown = held_where(drawn.image, filmed.unfilmed)
        if config.dssim_weight > 0:
            losses["dssim"] = config.dssim_weight * dssim_loss(shown, filmed.target)
        if config.lpips_weight > 0:
            losses["lpips"] = config.lpips_weight * self._lpips(shown, filmed.target)
        return losses

    def penalty(self, drawn: DrawnBatch, step: int) -> Losses:
        """How far the points' deformation is from the head model's at the nearest vertex."""
        config, points = self.config, self.deformed()
        places = points.place_at_rest.detach().cpu().numpy()
        nearest = torch.from_numpy(self._vertex_tree.query(places)[1]).to(self.position.device)
        factor = _halved(step // config.steps_per_epoch, _TERMS_HALVED)
        losses = {}
        for name, weight, own, model in (
            ("skinning", config.skinning_weight, points.skinning_weights, self._skinning),
            ("pose", config.pose_weight, _EXAGGERATED * points.pose_dirs, self._correctives),
            (
                *("expression", config.expression_weight),
                *(_EXAGGERATED * points.expression_dirs, self._expressions),
            ),
        ):
            if weight > 0 and own.numel():
                losses[name] = factor * weight * F.mse_loss(own, model[nearest])
        return losses

    def watches(self, step: int) -> bool:
        """All steps: what they draw opaque stays."""
        return True

    @torch.no_grad()
    def after_step(
        self,
        watched: WatchedStep | None,
        optimizers: Sequence[torch.optim.Optimizer],
        step: int,
        seed: int,
    ) -> Mapping[str, float]:
        """Note what is opaque."""
        if watched is not None:
            self.seen |= (watched.gaussians.opacities >= self.config.prune_opacity).any(0)
        return {}

    @torch.no_grad()
    def before_next_step(
        self, optimizers: Sequence[torch.optim.Optimizer], step: int, seed: int
    ) -> Mapping[str, float]:
        """Before the next epoch remove what was opaque in no step of this one, and refill."""
        epoch, of_epoch = divmod(step + 1, self.config.steps_per_epoch)
        # In a checkpoint of 0.2 it was done before the last step of an epoch was saved.
        if of_epoch or epoch <= int(self.epoch):
            return {}
        jitter_m = _LATE_JITTER_M if epoch > _LATE_EPOCH else radius_m(epoch - 1)
        changes = prune_and_refill(
            *(self._rows, self.seen, self.points_of(epoch), optimizers),
            jitter_m=jitter_m,
            step=step,
            seed=seed,
            remedy="Lower prune_opacity, give longer epochs (steps_per_epoch), and look at the "
            "mattes (`rgbavatar check`).",
        )
        self.seen.zero_()
        self.epoch.fill_(epoch)
        told = {"points": changes.count, "pruned": changes.pruned, "copied": changes.cloned}
        return {name: float(value) for name, value in told.items()}

    def fit_to(self, parameters: Mapping[str, Any], prefix: str = "") -> None:
        """Make room for as many points as are stored."""
        self._rows.fit_to(parameters, prefix)


def radius_m(epoch: int) -> float:
    """What all scales have at least in an epoch, and how far copies are moved (train.py)."""
    shrunk = sum(0 < start <= epoch for start in _POINTS if start != 60)
    shrunk += max(0, (epoch - 60) // 5)
    last = 0.9 if epoch >= 60 else 1.0
    return 0.15 * 0.75 ** (2 + shrunk) * last / _UNIT


@torch.no_grad()
def _draw_he_normal(network: nn.Module, generator: torch.Generator) -> None:
    """Initial values with which places differ: those of torch give all points nearly the same.

    Then what suits most pixels, transparency, takes all of them within sixty steps. Source: He et
    al. 2015, eq. 10; the release's, but for the first layer and the last of the attributes.
    """
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            layer.weight.normal_(0, (2 / layer.in_features) ** 0.5, generator=generator)
            layer.bias.zero_()


def _halved(epoch: int, milestones: tuple[int, ...]) -> float:
    return 0.5 ** sum(epoch >= milestone for milestone in milestones)


def _head_blendshapes(
    arrays: HeadArrays,
) -> tuple[Float[Tensor, "V E 3"], Float[Tensor, "V P 3"], Float[Tensor, "V J"]]:
    """The head model's directions and weights at its vertices, as `DeformedPoints` has them."""
    linear = [arrays.shapedirs[..., arrays.num_identity :]]
    if arrays.eyelid_dirs is not None:
        linear.append(arrays.eyelid_dirs)
    weights = np.pad(arrays.skinning_weights, ((0, 0), (1, 0)))
    directions = (np.concatenate(linear, -1), arrays.posedirs)
    expressions, correctives = (torch.from_numpy(d.transpose(0, 2, 1).copy()) for d in directions)
    return expressions, correctives, torch.from_numpy(weights)
