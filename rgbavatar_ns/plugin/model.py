"""RGBAvatar as nerfstudio's model: everything that is the method happens in `Avatar`."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss
from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.training.batches import DeviceFrames
from rgbavatar_ns.avatar.training.color_init import CHANGED_AT_END, FirstColorsKind, hide_unseen
from rgbavatar_ns.avatar.training.cuda_graph import Recorder
from rgbavatar_ns.avatar.training.losses import image_losses
from rgbavatar_ns.avatar.training.step import Orthogonality, TrainingOptions, TrainingStep
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.options import Counted, Weight
from rgbavatar_ns.plugin.avatar_model import AvatarModel, AvatarModelConfig, Outputs
from rgbavatar_ns.plugin.checkpoint_state import with_prior
from rgbavatar_ns.plugin.option_order import led_by


@led_by("avatar", "refine_tracking", "surface_prior", "lpips_weight", "rasterizer")
@dataclass
class RGBAvatarModelConfig(AvatarModelConfig):
    """The avatar and how it is trained."""

    _target: type = field(default_factory=lambda: RGBAvatarModel)
    avatar: AvatarConfig = field(default_factory=AvatarConfig)
    """Sizes, variants and initial values of the avatar."""
    initialize_colors: bool = True
    """Give each Gaussian the mean colour of the pixels it covers when it is first seen (paper,
    release: yes)."""
    first_colors: FirstColorsKind = "matted"
    """How: paper, the mean of the training picture over its random background, in the first step in
    which its weight exceeds .1; matted (ours), the mean of the person alone. (The release: .01.)"""
    surface_prior: bool = True
    """Keep what the film does not show on the person's surface, closed, and plain but for hair:
    heads can be turned beyond their film. Ours; False leaves it to chance, as the paper does."""
    hide_unseen: bool = False
    """At the end of a run make the Gaussians transparent that no training frame showed (release;
    the paper is silent). Off in ours, where the surface prior looks after them."""
    lpips_weight: Weight = 0.0
    """Weight of the LPIPS loss (paper: 0, and 0.05 for its sharper variant)."""
    lpips_start_step: Counted = 0
    """Step from which the LPIPS loss counts (paper: named without a start; release: 2000)."""
    orthogonality: Orthogonality = "free"
    """Leave the bases as they are (paper, release: free), or keep them orthogonal, by a loss of
    weight 10 or every 1,000 steps by QR decomposition or Gram-Schmidt (paper, supplement: none
    helps)."""
    fast: bool = True
    """Take training steps without autograd where that can be done, several times faster. It needs
    the method's own loss (no LPIPS) and optimizers (plain Adam, no max_norm) and the compiled
    rasterizer. False keeps to the readable path. Both give the same up to rounding, and a run can
    be resumed with the other."""
    batch_parallel: bool = True
    """Draw the images of a training batch together. False draws one after another and sums their
    gradients (the paper's "naive batch", to measure against), without `fast`."""


class RGBAvatarModel(AvatarModel):
    """Draws and trains an `Avatar`."""

    config: RGBAvatarModelConfig
    avatar: Avatar

    def populate_modules(self) -> None:
        """Build the avatar of the dataset's subject, and its prior."""
        if self.config.hide_unseen and not self.config.initialize_colors:
            raise UserError(
                "What was never seen is known by its missing first colour, and these are off.",
                "Leave out --pipeline.model.hide-unseen or --pipeline.model.initialize-colors.",
            )
        super().populate_modules()
        self.prior = SurfacePrior(self.avatar) if self.config.surface_prior else None
        self.lpips_loss = LPIPSLoss()

    def make_avatar(self, head: HeadModel, identity: Tensor, seed: int) -> Avatar:
        """A fresh avatar of the subject."""
        return Avatar(head, identity, self.config.avatar, seed=seed)

    def get_loss_dict(
        self,
        outputs: Outputs,
        batch: dict[str, Any],
        metrics_dict: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """L1 of both images over the batch's backgrounds, and LPIPS if it is on.

        The part that depends on the image: `TrainingStep` adds what bases and tracking ask for.
        """
        counts = self.training_options().lpips_counts(batch["step"])
        lpips = self.lpips_loss if counts else None
        return image_losses(
            outputs["rgb"], batch["image"], outputs["background"], lpips, self.config.lpips_weight
        )

    def training_options(self) -> TrainingOptions:
        """What the config says of training, as `TrainingStep` takes it."""
        config = self.config
        return TrainingOptions(
            lpips_weight=config.lpips_weight,
            lpips_start_step=config.lpips_start_step,
            first_colors=config.first_colors if config.initialize_colors else None,
            surface_prior=config.surface_prior,
            orthogonality=config.orthogonality,
            fast=config.fast,
            batch_parallel=config.batch_parallel,
            backend=config.rasterizer,
        )

    def training_step(
        self,
        optimizers: Iterable[torch.optim.Optimizer],
        max_norm: Mapping[str, float],
        frames: Callable[[], DeviceFrames | None],
        recorder: Recorder,
    ) -> TrainingStep:
        """The step that trains the avatar, for a run; `max_norm`: see `TrainingOptions`."""
        return TrainingStep(
            self.avatar,
            optimizers,
            replace(self.training_options(), max_norm=max_norm),
            frames=frames,
            refinement=self.refinement,
            prior=self.prior,
            lpips=self.lpips_loss,
            recorder=recorder,
        )

    def finish(self) -> bool:
        """Do what is due when all steps are done; whether that changed the avatar."""
        if self.config.hide_unseen:
            hide_unseen(self.avatar)
        return self.config.hide_unseen

    def changed_at_end(self) -> dict[str, Tensor]:
        """See `AvatarModel`: a run that goes on trains what was hidden, as if it had not ended."""
        state = self.avatar.state_dict()
        return {name: state[name].clone() for name in CHANGED_AT_END}

    @property
    def looks_back(self) -> bool:
        """Whether a run that is complete looks at all its training frames once more.

        Offline each was drawn often: only where what none shows is hidden.
        """
        return self.config.hide_unseen

    def of_this_version(self, state_dict: Mapping[str, Any]) -> dict[str, Any]:
        """See `AvatarModel`; and with a prior, or none, as this model has one."""
        return with_prior(super().of_this_version(state_dict), self.prior)
