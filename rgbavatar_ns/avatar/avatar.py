"""The avatar: the one composition from a head model's parameters theta to Gaussians and images."""

from contextlib import nullcontext
from dataclasses import fields
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.config import AvatarConfig
from rgbavatar_ns.avatar.method import AvatarMethod, require_pictures
from rgbavatar_ns.avatar.model.anchors import GaussianAnchors
from rgbavatar_ns.avatar.model.blendshapes import TangentBlendshapes
from rgbavatar_ns.avatar.model.kept_copy import KeptCopy, PictureCopy, own_tensors
from rgbavatar_ns.avatar.model.posing_parameters import posing_parameters
from rgbavatar_ns.avatar.model.tangent_to_world import tangent_to_world
from rgbavatar_ns.avatar.model.weight_network import WeightNetwork, softly_within
from rgbavatar_ns.avatar.storage.stored_avatar import RGBAVATAR
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, HeadModel, UVAnchors, uv_anchors
from rgbavatar_ns.kernels import (
    GaussianSet,
    MorphedGaussians,
    MorphedRenderer,
    PictureRenderer,
    PinholeCameras,
    RenderedBatch,
    morphed_renderer,
    packed_gaussians,
    picture_renderer,
    posing_of,
    rasterize,
)
from rgbavatar_ns.kernels.constants import MIN_ALPHA
from rgbavatar_ns.threads import using_threads

LEARNING_RATES: dict[str, float] = {
    "position": 8e-4,
    "rotation": 5e-3,
    "log_scale": 2.5e-2,
    "opacity": 0.25,
    "color": 1.25e-2,
    "basis_position": 8e-4 * 0.05,
    "basis_rotation": 5e-3 * 0.5,
    "basis_color": 1.25e-2 * 0.5,
    "weight_network": 1e-3,
}
"""Adam's learning rate for each parameter group (paper, supplement: implementation details)."""


FILM_RANGE = ("theta_low", "theta_high")
"""An avatar's buffers with the range of theta that training saw."""


class Avatar(AvatarMethod):
    """A head avatar of reduced Gaussian blendshapes, animated by theta (RGBAvatar, sec. 3.1).

    Everything that a picture needs is inside: head model, identity, anchors and Gaussians.

    Args:
        head: the head model, whose layout names what theta holds.
        identity: the subject's identity coefficients, fixed.
        config: sizes, variants and initial values.
        seed: of the weight network's initial values; nothing else is random.
        anchors: places of the Gaussians; by default every covered texel of the head's UV map.
    """

    method = RGBAVATAR
    config_type = AvatarConfig
    make_options = (
        "num_bases",
        "uv_resolution",
        "weight_network",
        "hidden_width",
        "tangent_variant",
        "pose_input",
        "translation_input",
        "scale_with_triangle",
        "carrier",
    )
    config: AvatarConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    color_initialized: Tensor
    theta_low: Float[Tensor, "H"]
    theta_high: Float[Tensor, "H"]

    def __init__(
        self,
        head: HeadModel,
        identity: Float[Tensor, "I"],
        config: AvatarConfig | None = None,
        *,
        seed: int = 0,
        anchors: UVAnchors | None = None,
    ) -> None:
        config = AvatarConfig() if config is None else config
        super().__init__(head, identity, config)
        self._for_pictures = KeptCopy[PictureCopy]()
        with torch.no_grad():
            rest_vertices = head(identity.new_zeros(self.layout.size), identity)
        if anchors is None:
            anchors = uv_anchors(head.uv, head.uv_faces, config.uv_resolution)
        self.anchors = GaussianAnchors(head, anchors, rest_vertices, config.tangent_variant)
        self.blendshapes = TangentBlendshapes(
            len(self.anchors),
            config.num_bases,
            scale_m=self.initial_scale_m(),
            opacity=config.initial_opacity,
            color=config.initial_color,
        )
        self.weight_network = None
        if config.weight_network == "none":
            part = self.layout.slice("expression")
            known = part.stop - part.start
            if config.num_bases > known:
                raise UserError(
                    f"{config.num_bases} bases without a weight network need as many expression "
                    f"coefficients; the head '{self.head.arrays.name}' has {known}.",
                    "Use fewer bases, or the weight network mlp or linear.",
                )
        elif config.num_bases > 0:
            self.weight_network = WeightNetwork(
                self.layout.feature_size(config.pose_input, config.translation_input),
                config.num_bases,
                kind=config.weight_network,
                hidden_width=config.hidden_width,
                generator=torch.Generator().manual_seed(seed),
            )
        self.register_buffer("color_initialized", torch.zeros(len(self.anchors), dtype=torch.bool))
        for name, end in zip(FILM_RANGE, (torch.inf, -torch.inf)):
            self.register_buffer(name, self.identity.new_full((self.layout.size,), end))

    @property
    def num_gaussians(self) -> int:
        """The number N of Gaussians."""
        return len(self.anchors)

    @property
    def num_bases(self) -> int:
        """The number K of blendshape bases."""
        return self.config.num_bases

    def initial_scale_m(self) -> Float[Tensor, "N"]:
        """Return the standard deviation that each Gaussian of a fresh avatar has, in metres."""
        if self.config.scale_from_texel_spacing:
            return 0.5 * self.anchors.texel_spacing()
        return self.identity.new_full((len(self.anchors),), self.config.initial_scale_m)

    def weights(self, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B K"]:
        """Return the blendshape weights psi = F(theta); raises UserError on a theta unfit.

        Beyond what training saw, F hardly follows: nothing taught it what is there.
        """
        return self.weights_of(self.weight_features(theta))

    def weight_features(self, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B _"]:
        """Return what F is told of theta, psi itself where there is no F; raises as `weights`."""
        theta = softly_within(self.checked(theta), self.theta_low, self.theta_high)
        if self.weight_network is None:
            return theta[:, self.layout.slice("expression")][:, : self.config.num_bases]
        return self.layout.network_features(
            theta, self.config.pose_input, self.config.translation_input
        )

    def weights_of(self, features: Float[Tensor, "B _"]) -> Float[Tensor, "B K"]:
        """Return psi of `weight_features`."""
        return features if self.weight_network is None else self.weight_network(features)

    @torch.no_grad()
    def widen_film_range(self, theta: Float[Tensor, "B H"]) -> None:
        """Count these frames' theta as what training saw, where the config has that matter."""
        if not self.config.theta_within_film:
            return
        theta = theta.to(self.theta_low)
        torch.minimum(self.theta_low, theta.amin(0), out=self.theta_low)
        torch.maximum(self.theta_high, theta.amax(0), out=self.theta_high)

    def carrier_vertices(self, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B V 3"]:
        """Return the posed mesh whose tangent frames carry the Gaussians, as `carrier` says."""
        if self.config.carrier == "joints":
            moves = theta.new_ones(self.layout.size)
            for part in self.layout.fields:
                if part.form == "linear":
                    moves[self.layout.slice(part.name)] = 0
            theta = theta * moves
        return self.head(theta, self.identity)

    def gaussians(
        self,
        theta: Float[Tensor, "B H"],
        psi: Float[Tensor, "B K"] | None = None,
        *,
        cameras: PinholeCameras | None = None,
    ) -> GaussianSet:
        """Return theta's Gaussians in the head's world; `psi` replaces the network's answer.

        Differentiable in the parameters, theta and psi; the same for all cameras. Raises UserError
        where theta has another size or holds NaN.
        """
        theta = self.checked(theta)
        tangent = self.blendshapes.morph(self.weights(theta) if psi is None else psi)
        vertices = self.carrier_vertices(theta)
        frames = self.anchors.frames(vertices, with_length_ratio=self.config.scale_with_triangle)
        return tangent_to_world(tangent, frames)

    def render(
        self,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        background: Float[Tensor, "3"] | Float[Tensor, "B 3"] | None = None,
        *,
        psi: Float[Tensor, "B K"] | None = None,
        backend: str = "auto",
        with_depth: bool = False,
        with_visibility: bool = False,
        differentiable: bool = False,
        to_be_seen: bool = False,
    ) -> RenderedBatch:
        """Draw a batch of theta; `psi` replaces the weight network's answer.

        Other options are those of `kernels.rasterize`. The picture carries no graph, unless it is
        to be `differentiable`: the same numbers through autograd, in several times as long. One
        picture that is only `to_be_seen` may come from Gaussians in fewer bits
        (`kernels.PackedGaussians`), its mesh and weights from compiled loops (`kernels.Posing`);
        both are made once the avatar is drawn again unchanged.
        """
        require_pictures(theta)
        options: dict[str, Any] = {"with_depth": with_depth, "with_visibility": with_visibility}
        background = None if background is None else background.to(self.identity)
        # More cameras or colours than theta make more pictures, which `rasterize` alone draws.
        count = len(theta) if theta.ndim else 0
        alike = background is None or background.numel() in (3, 3 * count)
        alone = alike and count == 1 == len(cameras.focal_px)
        with nullcontext() if differentiable else torch.no_grad():
            if to_be_seen and alone and not (differentiable or with_visibility):
                picture = self.picture_renderer(theta, cameras, psi, backend=backend)
                if picture is not None:
                    return picture.draw(background, with_depth=with_depth)
            renderer = None
            if alike and not differentiable:
                renderer = self.renderer(theta, cameras, psi, backend=backend)
            if renderer is None:
                gaussians = self.gaussians(theta, psi)
                return rasterize(gaussians, cameras, background, backend=backend, **options)
            return renderer.draw(background, **options)

    def renderer(
        self,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        psi: Float[Tensor, "B K"] | None = None,
        vertices: Float[Tensor, "B V 3"] | None = None,
        *,
        backend: str = "auto",
    ) -> MorphedRenderer | None:
        """Return the backend's way to draw and train without `gaussians`, if it has one.

        `psi` and `vertices` replace the answers of weight network and head model. Raises UserError
        where theta is unfit.
        """
        weights, posed = self._driven(theta, psi, vertices)
        return morphed_renderer(self._morphed_gaussians(), weights, posed, cameras, backend)

    def picture_renderer(
        self,
        theta: Float[Tensor, "1 H"],
        cameras: PinholeCameras,
        psi: Float[Tensor, "1 K"] | None = None,
        vertices: Float[Tensor, "1 V 3"] | None = None,
        *,
        backend: str = "auto",
    ) -> PictureRenderer | None:
        """Return the backend's way to a picture that is to be seen; None where it has none.

        Nor has it one the first time after the avatar has changed. Arguments and errors are those
        of `renderer`.
        """
        network = () if self.weight_network is None else self.weight_network.linear_layers()
        parts = self, self.head, self.anchors, self.blendshapes, *network
        state = (backend, self.config, self.anchors.variant)
        copy = self._for_pictures.of(own_tensors(parts), state, lambda: self._copied(backend))
        if copy is None:
            return None
        if copy.posing is None or not (psi is None or vertices is None):
            weights, posed = self._driven(theta, psi, vertices)
        else:
            weights, posed = copy.posing(self.checked(theta))
            weights = weights if psi is None else psi
            posed = posed if vertices is None else vertices
        return picture_renderer(copy.packed, copy.gaussians, weights, posed, cameras)

    def _copied(self, backend: str) -> PictureCopy | None:
        gaussians = self._morphed_gaussians()
        packed = packed_gaussians(gaussians, backend)
        if packed is None:
            return None
        film_range = self.theta_low, self.theta_high
        posing = posing_parameters(
            self.head, self.identity, film_range, self.weight_network, self.config
        )
        return PictureCopy(gaussians, packed, posing_of(posing, backend))

    @torch.no_grad()
    def _driven(
        self, theta: Float[Tensor, "B H"], psi: Tensor | None, vertices: Tensor | None
    ) -> tuple[Float[Tensor, "B K"], Float[Tensor, "B V 3"]]:
        """Weights and posed mesh, unless they are there; compiled loops follow at once."""
        theta = self.checked(theta)
        with using_threads(1):
            weights = self.weights(theta) if psi is None else psi
            posed = self.carrier_vertices(theta) if vertices is None else vertices
        return weights, posed

    def _morphed_gaussians(self) -> MorphedGaussians:
        names = [field.name for field in fields(MorphedGaussians)]
        tensors: dict[str, Any] = {n: getattr(self.blendshapes, n, None) for n in names}
        follows = self.config.scale_with_triangle
        return MorphedGaussians(**tensors | self.anchors.triangles(with_rest_length=follows))

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters by the names in `LEARNING_RATES`; none for bases where K = 0."""
        shapes = self.blendshapes
        groups = {
            "position": [shapes.position],
            "rotation": [shapes.rotation_wxyz],
            "log_scale": [shapes.log_scale],
            "opacity": [shapes.opacity_logit],
            "color": [shapes.color_feature],
        }
        if self.config.num_bases > 0:
            groups["basis_position"] = [shapes.basis_position]
            groups["basis_rotation"] = [shapes.basis_rotation_wxyz]
            groups["basis_color"] = [shapes.basis_color_feature]
        if self.weight_network is not None:
            groups["weight_network"] = list(self.weight_network.parameters())
        return groups

    def learning_rates(self) -> dict[str, float]:
        """Return the paper's (supplement: implementation details)."""
        return LEARNING_RATES

    def defaults_of_before(self) -> dict[str, Tensor]:
        """Of an avatar that was trained before its range was kept, none is known."""
        return {name: getattr(self, name) for name in FILM_RANGE}

    def to_state(self) -> dict[str, Any]:
        """Return what `from_state` needs beside the state dict, safe for `weights_only=True`."""
        return super().to_state() | {
            "anchors": {
                name: value.cpu() if isinstance(value, Tensor) else value
                for name, value in self.anchors.to_state().items()
            },
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Avatar":
        """Build an untrained avatar of the same make; its parameters come by load_state_dict."""
        saved = state["anchors"]
        anchors = UVAnchors(
            triangle_index=saved["triangle_index"].long(),
            barycentric=saved["barycentric"],
            texel_row_col=saved["texel_row_col"].long(),
            resolution=saved["resolution"],
        )
        return cls(
            HeadModel(HeadArrays.from_state(state["head"])),
            state["identity"],
            AvatarConfig.from_json(state["config"]),
            anchors=anchors,
        )

    def without_undrawn(self) -> "Avatar":
        """Return the avatar without Gaussians too transparent for any picture; images stay.

        Opacities change with no theta, so that these show in none.
        """
        drawn = self.blendshapes.opacity_logit.detach().sigmoid() >= MIN_ALPHA
        return self.with_gaussians(torch.nonzero(drawn)[:, 0])

    def with_gaussians(self, places: Int[Tensor, "M"]) -> "Avatar":
        """Return the avatar with only the Gaussians of these places, in this order."""
        state, places = self.to_state(), places.to(self.identity.device)
        for name, value in state["anchors"].items():
            if isinstance(value, Tensor):
                state["anchors"][name] = value[places.cpu()]
        chosen = Avatar.from_state(state).to(self.identity)
        own = self.own_state_dict()
        for name, value in own.items():
            if name.startswith(("anchors.", "blendshapes.", "color_initialized")):
                axis = 1 if ".basis_" in name else 0
                own[name] = value.index_select(axis, places)
        chosen.load_state_dict(own, strict=False)
        chosen.training_statistics = self.training_statistics
        return chosen
