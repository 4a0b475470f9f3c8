"""The methods that the paper compares with, as nerfstudio's commands list them.

They train on the same data, pictures and backgrounds as RGBAvatar, with one rasterizer, so that
what differs between them is the method (docs/rivals.md).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.plugins.types import MethodSpecification
from nerfstudio.utils import writer
from torch import Tensor

from rgbavatar_ns.avatar.config import MethodConfig
from rgbavatar_ns.avatar.loading import METHODS
from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.methods.flashavatar import FlashAvatarConfig
from rgbavatar_ns.avatar.methods.gaussianavatars import GaussianAvatarsConfig
from rgbavatar_ns.avatar.methods.gaussianblendshapes import (
    GaussianBlendshapesConfig,
)
from rgbavatar_ns.avatar.methods.monogaussianavatar import (
    MonoGaussianAvatarConfig,
)
from rgbavatar_ns.avatar.methods.splattingavatar import SplattingAvatarConfig
from rgbavatar_ns.avatar.training.batches import DeviceFrames
from rgbavatar_ns.avatar.training.cuda_graph import Recorder
from rgbavatar_ns.avatar.training.method_step import MethodStep
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.plugin.avatar_model import AvatarModel, AvatarModelConfig
from rgbavatar_ns.plugin.datamanager import RGBAvatarDataManagerConfig
from rgbavatar_ns.plugin.methods import preset
from rgbavatar_ns.plugin.option_order import led_by
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipelineConfig
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainerConfig

_METHOD_OF: dict[type[MethodConfig], Any] = {
    method.config_type: method for method in METHODS.values()
}


@led_by("avatar", "refine_tracking", "rasterizer")
@dataclass
class RivalModelConfig(AvatarModelConfig):
    """A rival's avatar, and what all methods have beside it."""

    _target: type = field(default_factory=lambda: RivalModel)
    avatar: MethodConfig = field(default_factory=GaussianAvatarsConfig)
    """The method's own options."""


class RivalModel(AvatarModel):
    """Draws and trains an avatar of any method, eagerly."""

    config: RivalModelConfig

    def make_avatar(self, head: HeadModel, identity: Tensor, seed: int) -> AvatarMethod:
        """A fresh avatar of the subject."""
        return _METHOD_OF[type(self.config.avatar)](head, identity, self.config.avatar, seed=seed)

    def training_step(
        self,
        optimizers: Iterable[torch.optim.Optimizer],
        max_norm: Mapping[str, float],
        frames: Callable[[], DeviceFrames | None],
        recorder: Recorder,
    ) -> MethodStep:
        """The step that trains the avatar, for a run; UserError where gradients are clipped."""
        if max_norm:
            raise UserError(
                f"Gradients of {', '.join(max_norm)} are to be clipped, which this method does "
                "not do.",
                "Leave out --optimizers.*.optimizer.max-norm.",
            )
        return MethodStep(
            self.avatar,
            optimizers,
            seed=self.config.seed or 0,
            refinement=self.refinement,
            backend=self.config.rasterizer,
            logged=_log,
        )


def _log(step: int, figures: Mapping[str, float]) -> None:
    """Write what followed a step, as how many Gaussians were added and removed, beside the loss."""
    writer.put_dict(name="Gaussians", scalar_dict=dict(figures), step=step)


def _rival(config: MethodConfig, steps: int, told: str, batch_size: int = 1) -> MethodSpecification:
    """A method at its own length, on as many images a step as its release takes."""
    return MethodSpecification(
        config=preset(
            RGBAvatarTrainerConfig,
            _METHOD_OF[type(config)].method,
            pipeline=RGBAvatarPipelineConfig(
                datamanager=RGBAvatarDataManagerConfig(batch_size=batch_size),
                model=RivalModelConfig(avatar=config),
            ),
            optimizers={},  # Adam at the method's own rates
            max_num_iterations=steps,
            steps_per_save=1000,
        ),
        description=f"{told} Ours in their manner, for comparison (docs/rivals.md).",
    )


gaussianavatars = _rival(
    GaussianAvatarsConfig(), 40_000, "GaussianAvatars (CVPR 2024): Gaussians bound to triangles."
)
splattingavatar = _rival(
    SplattingAvatarConfig(), 30_000, "SplattingAvatar (CVPR 2024): Gaussians that walk on a mesh."
)
flashavatar = _rival(
    FlashAvatarConfig(), 30_000, "FlashAvatar (CVPR 2024): a UV map of Gaussians, offset by an MLP."
)
gaussianblendshapes = _rival(
    GaussianBlendshapesConfig(),
    40_000,
    "3D Gaussian Blendshapes (SIGGRAPH 2024): a Gaussian basis for each expression.",
)
monogaussianavatar = _rival(
    MonoGaussianAvatarConfig(),
    50_000,  # 100 epochs, as FATE trains it (the release: 600); its points are all there after 60
    "MonoGaussianAvatar (SIGGRAPH 2024): points that networks deform and colour.",
    batch_size=10,
)
