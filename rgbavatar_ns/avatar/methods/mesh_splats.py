"""What methods have alike whose Gaussians lie on a triangle each, and are added and removed."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.config import MethodConfig
from rgbavatar_ns.avatar.method import AvatarMethod, WatchedStep
from rgbavatar_ns.avatar.methods.carriers import require_places
from rgbavatar_ns.avatar.methods.density import (
    ControlledGaussians,
    DensityControl,
    ScreenStatistics,
    control,
)
from rgbavatar_ns.avatar.methods.gaussian_rows import GaussianRows
from rgbavatar_ns.head import HeadModel


class MeshSplats(AvatarMethod):
    """Gaussians on triangles, under density control; where on its triangle one lies is left open.

    Args:
        head: the head model; any of its triangles carries Gaussians.
        identity: the subject's identity coefficients, fixed.
        config: the method's options.
        density: when and where Gaussians are added and removed.
    """

    face_index: Int[Tensor, "N"]

    def __init__(
        self,
        head: HeadModel,
        identity: Float[Tensor, "I"],
        config: MethodConfig,
        density: DensityControl,
    ) -> None:
        super().__init__(head, identity, config)
        self._density = density
        self.register_load_state_dict_post_hook(
            lambda module, _: require_places(module.face_index, module.head.faces)
        )

    def _make_gaussians(
        self, face_index: Int[Tensor, "N"], log_scale: Float[Tensor, "N"], opacity: float
    ) -> None:
        """Begin with round, unturned, grey Gaussians on these triangles."""
        count, like = len(face_index), log_scale
        self.register_buffer("face_index", face_index)
        self.rotation_wxyz = nn.Parameter(like.new_tensor([1.0, 0, 0, 0]).repeat(count, 1))
        self.log_scale = nn.Parameter(log_scale[:, None].repeat(1, 3))
        self.opacity_logit = nn.Parameter(like.new_full((count,), opacity).logit())
        self.color = nn.Parameter(like.new_zeros(count, 1, 3))
        self.statistics = ScreenStatistics(count).to(like)

    def _keep_rows(self, *places: str) -> None:
        """Let density control change these tensors too; called when all of them are there."""
        shared = ("rotation_wxyz", "log_scale", "opacity_logit", "color")
        self.rows = GaussianRows(self, (*places, *shared, "face_index", "statistics"))

    @property
    def num_gaussians(self) -> int:
        """The number N of Gaussians."""
        return self.rows.count

    def watches(self, step: int) -> bool:
        """Whether density control still uses the gradient by the projected means."""
        return self._density.watches(step)

    def after_step(
        self,
        watched: WatchedStep | None,
        optimizers: Sequence[torch.optim.Optimizer],
        step: int,
        seed: int,
    ) -> Mapping[str, float]:
        """Note where Gaussians are too few."""
        if watched is not None:
            self.statistics.add_step(watched)
        return {}

    def before_next_step(
        self, optimizers: Sequence[torch.optim.Optimizer], step: int, seed: int
    ) -> Mapping[str, float]:
        """Add and remove Gaussians, where that is due."""
        known = ControlledGaussians(
            self.rows, self.statistics, self._scale_m, self._children, face_of="face_index"
        )
        changes = control(known, self._density, optimizers, step=step, seed=seed)
        return {} if changes is None else changes.figures()

    @abstractmethod
    def _scale_m(self) -> Float[Tensor, "N 3"]:
        """Standard deviations at rest."""

    @abstractmethod
    def _children(
        self, chosen: Int[Tensor, "M"], samples: Float[Tensor, "M S 3"]
    ) -> dict[str, Tensor]:
        """The places of those into which Gaussians are split (`SplitRule`)."""

    def fit_to(self, parameters: Mapping[str, Any], prefix: str = "") -> None:
        """Make room for the Gaussians of a stored state dict."""
        self.rows.fit_to(parameters, prefix)
