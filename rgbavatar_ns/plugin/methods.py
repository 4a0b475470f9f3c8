"""The methods that nerfstudio's commands list: `rgbavatar`, `rgbavatar-quick` and others.

docs/paper.md says what each of them changes of the paper's.
"""

import sys
from typing import Any, TypeVar

import torch
from nerfstudio.configs.base_config import (
    LocalWriterConfig,
    LoggingConfig,
    MachineConfig,
    ViewerConfig,
)
from nerfstudio.plugins.types import MethodSpecification

from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.kernels import available_backends
from rgbavatar_ns.plugin.datamanager import RGBAvatarDataManagerConfig
from rgbavatar_ns.plugin.model import RGBAvatarModelConfig
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipelineConfig
from rgbavatar_ns.plugin.training import optimizers as optimizers_module
from rgbavatar_ns.plugin.training import trainer
from rgbavatar_ns.plugin.training.optimizers import paper_optimizers
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainerConfig

# Earlier runs name their configs in config.yml by the modules that these then were.
for _earlier, _module in {"trainer": trainer, "optimizers": optimizers_module}.items():
    sys.modules.setdefault(f"rgbavatar_ns.plugin.{_earlier}", _module)

TrainerKind = TypeVar("TrainerKind", bound=RGBAvatarTrainerConfig)

FALLING: dict[str, Any] = {"position_lr_final": 8e-5, "learning_rate_factor": 0.1}
"""All rates fall to a tenth, ours: the paper's stay what they are, and with them the noise."""
_FALLING_LINEARLY: dict[str, Any] = {
    "position_lr_final": 1.6e-5,
    "learning_rate_factor": 0.02,
    "learning_rate_decay": "linear",
}
"""What few steps make more of: rates that are higher for longer, and then lower (docs/speed.md)."""


def preset(
    kind: type[TrainerKind],
    method_name: str,
    optimizers: dict[str, Any] | None = None,
    **settings: Any,
) -> TrainerKind:
    """A trainer's config with what all methods share."""
    # A GPU is used once the rasterizer has a backend for it.
    gpu = torch.cuda.is_available() and "cuda" in available_backends()
    return kind(
        method_name=method_name,
        steps_per_eval_batch=500,
        steps_per_eval_image=500,
        steps_per_eval_all_images=1_000_000,
        optimizers=paper_optimizers() if optimizers is None else optimizers,
        machine=MachineConfig(device_type="cuda" if gpu else "cpu"),
        # The trainer shows its own progress; nerfstudio's table knows no images per second. Reading
        # a loss waits for the device, and a GPU takes hundreds of steps a second.
        logging=LoggingConfig(
            steps_per_log=50 if gpu else 10,
            local_writer=LocalWriterConfig(enable=False),
            profiler="none",
        ),
        # A monocular video has one camera: many frusta would only hide each other.
        # Depth for what is drawn over the head costs more than the picture.
        viewer=ViewerConfig(
            websocket_host="127.0.0.1",
            max_num_display_images=1,
            default_composite_depth=False,
            jpeg_quality=90,
        ),
        vis="viewer+tensorboard",
        **settings,
    )


def paper_model() -> RGBAvatarModelConfig:
    """The paper's model, and the release's where the paper is silent (docs/paper.md)."""
    return RGBAvatarModelConfig(
        avatar=AvatarConfig(tangent_variant="raw", theta_within_film=False),
        surface_prior=False,
        first_colors="paper",
        hide_unseen=True,
    )


def tiny_model() -> RGBAvatarModelConfig:
    """An avatar of fewer Gaussians."""
    avatar = AvatarConfig(uv_resolution=128, scale_from_texel_spacing=True)
    return RGBAvatarModelConfig(avatar=avatar, lpips_metric=False)


rgbavatar = MethodSpecification(
    config=preset(
        RGBAvatarTrainerConfig,
        "rgbavatar",
        max_num_iterations=5000,
        **FALLING,
        steps_per_save=500,
    ),
    description="RGBAvatar: head avatars of reduced Gaussian blendshapes. Parts from its paper in "
    "tangent frames, first colours, falling rates and what the film does not show (docs/paper.md).",
)

rgbavatar_quick = MethodSpecification(
    config=preset(
        RGBAvatarTrainerConfig,
        "rgbavatar-quick",
        # Six images a step reach with 7,500 what ten do with 20,000 (docs/speed.md).
        pipeline=RGBAvatarPipelineConfig(
            datamanager=RGBAvatarDataManagerConfig(batch_size=6),
            model=RGBAvatarModelConfig(lpips_metric=False),
        ),
        max_num_iterations=1250,
        **_FALLING_LINEARLY,
        learning_rate_steps=1250,
        steps_per_save=250,
    ),
    description="rgbavatar in small batches, rates falling: sharp within two minutes on a CPU.",
)

rgbavatar_paper = MethodSpecification(
    config=preset(
        RGBAvatarTrainerConfig,
        "rgbavatar-paper",
        pipeline=RGBAvatarPipelineConfig(model=paper_model()),
        max_num_iterations=5000,
        steps_per_save=500,
    ),
    description="RGBAvatar to the letter of its paper, and as its release where that is silent.",
)

rgbavatar_tiny = MethodSpecification(
    config=preset(
        RGBAvatarTrainerConfig,
        "rgbavatar-tiny",
        pipeline=RGBAvatarPipelineConfig(model=tiny_model()),
        max_num_iterations=1500,
        **FALLING,
        # Named, so that a run resumed with more steps equals one that had them from the start (but
        # with refined tracking, whose bases begin to learn sooner in the shorter one).
        learning_rate_steps=1500,
        steps_per_save=250,
    ),
    description="rgbavatar with fewer Gaussians and steps, and rates that fall: minutes on a CPU.",
)
