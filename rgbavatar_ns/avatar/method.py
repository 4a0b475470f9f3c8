"""What every method of head avatars is: from theta to Gaussians, and how it is trained and kept."""

import functools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from rgbavatar_ns.avatar.config import MethodConfig
from rgbavatar_ns.avatar.model.image_loss import l1_loss
from rgbavatar_ns.avatar.storage.bundle import load_any, save_bundle
from rgbavatar_ns.avatar.storage.head_reference import reference_to
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.avatar.storage.stored_avatar import StoredAvatar
from rgbavatar_ns.drawing.compositing import ImagesRGBA
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, HeadModel, ThetaLayout
from rgbavatar_ns.head.arkit import ArkitMap, arkit_map, arkit_rows
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, RenderedBatch, rasterize
from rgbavatar_ns.kernels.checks import holds_nonfinite

Kind = TypeVar("Kind", bound="AvatarMethod")
Losses = dict[str, Float[Tensor, ""]]


@dataclass(frozen=True)
class DrawnBatch:
    """What a training step has drawn, with its graph: the Gaussians, and their pictures."""

    theta: Float[Tensor, "B H"]
    cameras: PinholeCameras
    gaussians: GaussianSet
    image: Float[Tensor, "B H_px W_px 3"]
    """Over the step's backgrounds."""
    alpha: Float[Tensor, "B H_px W_px 1"]


@dataclass(frozen=True)
class FilmedBatch:
    """What was filmed, over the same backgrounds.

    `target` equals the drawn picture, without its graph, where nobody filmed (`unfilmed`), so that
    differences there are 0.
    """

    images_rgba: ImagesRGBA
    background: Float[Tensor, "B 3"]
    target: Float[Tensor, "B H_px W_px 3"]
    matte: Float[Tensor, "B H_px W_px 1"]
    unfilmed: Bool[Tensor, "B H_px W_px"]


@dataclass(frozen=True)
class WatchedStep:
    """What a step left for density control: the gradient of its loss by the projected means."""

    gaussians: GaussianSet
    cameras: PinholeCameras
    screen_gradient_px: Float[Tensor, "B N 2"]


class AvatarMethod(nn.Module, ABC):
    """A head avatar that theta animates; everything that a picture needs is inside.

    Args:
        head: the head model, whose layout names what theta holds.
        identity: the subject's identity coefficients, fixed.
        config: the method's options, as `to_state` keeps them.
    """

    method: ClassVar[str]
    """The name that files bear."""
    config_type: ClassVar[type[MethodConfig]]
    """What `config` is."""
    make_options: ClassVar[tuple[str, ...]] = ()
    """The options that a checkpoint and the run that goes on with it must agree in."""
    config: MethodConfig
    identity: Tensor
    training_statistics: TrainingStatistics | None
    """What the file that it was loaded from knows about its training; None where it knows nothing,
    and of an avatar that was made here."""

    def __init__(self, head: HeadModel, identity: Float[Tensor, "I"], config: MethodConfig) -> None:
        super().__init__()
        self.head, self.config = head, config
        self.training_statistics = None
        self.register_buffer("identity", identity.detach().clone())

    @property
    def layout(self) -> ThetaLayout:
        """The names and sizes of theta's parts."""
        return self.head.layout

    @property
    @abstractmethod
    def num_gaussians(self) -> int:
        """The number N of Gaussians."""

    @property
    def num_bases(self) -> int:
        """The number K of blendshape bases that `weights` weighs; 0 where there are none."""
        return 0

    @abstractmethod
    def gaussians(
        self, theta: Float[Tensor, "B H"], *, cameras: PinholeCameras | None = None
    ) -> GaussianSet:
        """Return theta's Gaussians in the head's world, differentiably.

        Colours that depend on the view are those of `cameras`, or without any those of all views
        in the mean. Raises UserError where theta has another size or holds NaN.
        """

    @abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return what is trained, by the names in `learning_rates`."""

    @abstractmethod
    def learning_rates(self) -> dict[str, float]:
        """Return Adam's learning rate of each parameter group before any schedule."""

    def rate_factors(self, step: int) -> dict[str, float]:
        """Return what the learning rates of `step` are multiplied by, where that is not 1.

        By the names of parameter groups; `step` is counted from 0.
        """
        return {}

    def image_losses(self, drawn: DrawnBatch, filmed: FilmedBatch, step: int) -> Losses:
        """The parts of the loss that compare pictures: L1 unless a method says otherwise.

        `step` is counted from 0.
        """
        return {"l1": l1_loss(drawn.image, filmed.target)}

    def penalty(self, drawn: DrawnBatch, step: int) -> Losses:
        """The parts of the loss that no picture has: none unless a method says otherwise."""
        return {}

    def watches(self, step: int) -> bool:
        """Whether `after_step` wants the gradient by the projected means of `step`."""
        return False

    def after_step(
        self,
        watched: WatchedStep | None,
        optimizers: Sequence[torch.optim.Optimizer],
        step: int,
        seed: int,
    ) -> Mapping[str, float]:
        """What the method notes once the optimisers have taken `step`; returns figures for logs.

        What a later step would have to train belongs into `before_next_step`.
        """
        return {}

    def before_next_step(
        self, optimizers: Sequence[torch.optim.Optimizer], step: int, seed: int
    ) -> Mapping[str, float]:
        """What the method changes between `step` and the one that follows; figures for logs.

        Not called after a run's last step, so that a run ends with what it has trained; one that
        goes on from there begins with it. `step`, which has been taken, is counted from 0.
        """
        return {}

    def weights(self, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B K"]:
        """Return the weights of blendshape bases; K is 0 where the method has none."""
        return self.checked(theta).new_zeros(len(theta), 0)

    def carrier_vertices(self, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B V 3"]:
        """Return the posed mesh that carries the Gaussians, in metres."""
        return self.head(theta, self.identity)

    @functools.cached_property
    def arkit(self) -> ArkitMap:
        """How ARKit's 52 coefficients move this head; takes seconds the first time with FLAME."""
        return arkit_map(self.head.arrays)

    def theta_from_arkit(
        self,
        coefficients: Mapping[str, int | float] | Float[Tensor, "*batch 52"],
        head_rotation: Float[Tensor, "*batch 3"] | None = None,
    ) -> Float[Tensor, "*batch H"]:
        """Return theta of ARKit coefficients in [0, 1] and the head's turn.

        coefficients: by name, or in the order of `ARKIT_NAMES`. head_rotation: axis-angle, radians,
        x the subject's left, y up, z out of the face. The head stays where it is at rest. Raises
        UserError for an unknown name, a value that is no number or another number of columns.
        """
        rows = arkit_rows(coefficients)
        given = [rows] if head_rotation is None else [rows, head_rotation]
        if not all(bool(torch.isfinite(part).all()) for part in given):
            raise UserError("The ARKit values hold NaN.", "Give numbers from 0 to 1, and radians.")
        return self.arkit.theta(rows.to(self.identity), head_rotation)

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
        """Draw a batch of theta; `psi` replaces the blendshape weights, where there are any.

        Other options are those of `kernels.rasterize`. The picture carries no graph, unless it is
        to be `differentiable`. Where it is only `to_be_seen`, a method may draw it more quickly and
        within 1/512.
        """
        if psi is not None and psi.shape[-1] > 0:
            raise ValueError(f"{self.method} has no blendshape weights. Leave out psi.")
        require_pictures(theta)
        with nullcontext() if differentiable else torch.no_grad():
            return rasterize(
                self.gaussians(theta, cameras=cameras),
                cameras,
                None if background is None else background.to(self.identity),
                backend=backend,
                with_depth=with_depth,
                with_visibility=with_visibility,
            )

    def checked(self, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B H"]:
        """Return theta in the avatar's dtype, on its device, or raise UserError with the reason."""
        if theta.ndim != 2:
            raise UserError(
                f"theta is {list(theta.shape)}, but a batch is wanted: [B, {self.layout.size}], a "
                "row for each picture.",
                "Give one frame's as theta[None].",
            )
        if theta.shape[1] != self.layout.size:
            raise UserError(
                f"theta has {theta.shape[1]} values, but this avatar's head "
                f"'{self.head.arrays.name}' takes {describe_layout(self.layout)}.",
                "Give theta of the head model that the avatar was trained with.",
            )
        # Of a GPU this is not asked; data is checked when loaded.
        if holds_nonfinite(theta):
            raise UserError(
                "theta holds NaN or infinite values.", "Repair or leave out these frames."
            )
        return theta.to(self.identity)

    def require_layout(self, layout: ThetaLayout, source: str) -> None:
        """Raise UserError, naming both layouts, where `source` has another than this avatar."""
        if layout != self.layout:
            raise UserError(
                f"{source} has theta of {describe_layout(layout)}, but this avatar's head "
                f"'{self.head.arrays.name}' takes {describe_layout(self.layout)}.",
                "Use data of the same head model, or train an avatar on this data.",
            )

    def to_state(self) -> dict[str, Any]:
        """Return what `from_state` needs beside the state dict, safe for `weights_only=True`."""
        return {
            "method": self.method,
            "config": self.config.to_json(),
            "head": self.head.arrays.to_state(),
            "identity": self.identity.detach().cpu(),
        }

    @classmethod
    def from_state(cls: type[Kind], state: dict[str, Any]) -> Kind:
        """Build an untrained avatar of the same make; its parameters come by load_state_dict."""
        return cls(
            HeadModel(HeadArrays.from_state(state["head"])),
            state["identity"],
            cls.config_type.from_json(state["config"]),
        )

    def fit_to(self, parameters: Mapping[str, Any], prefix: str = "") -> None:
        """Make room for a stored state dict whose number of Gaussians may be another."""

    def own_state_dict(self) -> dict[str, Tensor]:
        """Return the state dict without the head model's part, which `to_state` carries."""
        return {k: v for k, v in self.state_dict().items() if not k.startswith("head.")}

    def save(
        self,
        path: str | Path,
        *,
        statistics: TrainingStatistics | None = None,
        with_head: bool = True,
    ) -> None:
        """Write a bundle (a directory of avatar.safetensors and avatar.json), atomically.

        statistics: of the frames that it was trained on, which driving asks for
        (`export.statistics_of`); without any, those that it was loaded with. Without `with_head` it
        only names its head model, as the licence of FLAME asks where the bundle is passed on;
        `load` then wants the file (RGBAVATAR_HEAD).
        """
        state = self.to_state()
        if not with_head:
            state["head"] = reference_to(self.head.arrays)
        seen = self.training_statistics if statistics is None else statistics
        save_bundle(state, self.own_state_dict(), Path(path), self.layout, seen)

    @classmethod
    def load(cls: type[Kind], path: str | Path) -> Kind:
        """Load a bundle, a nerfstudio checkpoint (.ckpt) or the newest one of a run's folder.

        Needs no nerfstudio. Raises UserError where there is none, it cannot be read, or another
        method made it.
        """
        stored = load_any(Path(path))
        if stored.method != cls.method:
            raise UserError(
                f"The avatar {path} is one of {stored.method}, and {cls.method} is needed here.",
                "Give an avatar of that method, or take a command that takes any.",
            )
        return cls.of_stored(stored)

    @classmethod
    def of_stored(cls: type[Kind], stored: StoredAvatar) -> Kind:
        """Build the avatar that a file holds; raises UserError where it is damaged."""
        stored.check()
        with stored.damage_told():
            avatar = cls.from_state(stored.state)
            parameters = avatar.defaults_of_before() | stored.parameters
            avatar.fit_to(parameters)
            own = avatar.own_state_dict()
            replace(stored, parameters=parameters).check_fits(own, avatar.layout.to_json())
            avatar.load_state_dict({name: parameters[name] for name in own}, strict=False)
            avatar.training_statistics = stored.statistics_of(avatar.layout)
        return avatar

    def defaults_of_before(self) -> dict[str, Tensor]:
        """What files of earlier versions lack, by its name in the state dict."""
        return {}


def require_pictures(theta: Tensor) -> None:
    """Raise ValueError for a batch of no theta, of which no backend makes pictures."""
    if theta.ndim == 2 and len(theta) == 0:
        raise ValueError("theta: leading dimension 0. Pass at least 1: there is no empty batch.")


def describe_layout(layout: ThetaLayout) -> str:
    """Say a layout in words: its size, then each part's name and size."""
    return f"{layout.size} values ({layout})"
