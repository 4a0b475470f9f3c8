"""The methods that nerfstudio's commands list: `rgbavatar` and `rgbavatar-tiny`."""

import torch
from nerfstudio.configs.base_config import (
    LocalWriterConfig,
    LoggingConfig,
    MachineConfig,
    ViewerConfig,
)
from nerfstudio.plugins.types import MethodSpecification

from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.plugin.model import RGBAvatarModelConfig
from rgbavatar_ns.plugin.optimizers import paper_optimizers
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipelineConfig
from rgbavatar_ns.plugin.trainer import RGBAvatarTrainerConfig


def _machine() -> MachineConfig:
    return MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu")


def _logging() -> LoggingConfig:
    # The trainer shows its own progress; nerfstudio's table knows no images per second.
    local_writer = LocalWriterConfig(enable=False)
    return LoggingConfig(steps_per_log=10, local_writer=local_writer, profiler="none")


def _viewer() -> ViewerConfig:
    # A monocular video has one camera: many frusta would only hide each other.
    return ViewerConfig(websocket_host="127.0.0.1", max_num_display_images=1)


rgbavatar = MethodSpecification(
    config=RGBAvatarTrainerConfig(
        method_name="rgbavatar",
        max_num_iterations=5000,
        steps_per_save=500,
        steps_per_eval_batch=500,
        steps_per_eval_image=500,
        steps_per_eval_all_images=1_000_000,
        optimizers=paper_optimizers(),
        machine=_machine(),
        logging=_logging(),
        viewer=_viewer(),
        vis="viewer+tensorboard",
    ),
    description="RGBAvatar: head avatars of reduced Gaussian blendshapes, as in the paper.",
)

rgbavatar_tiny = MethodSpecification(
    config=RGBAvatarTrainerConfig(
        method_name="rgbavatar-tiny",
        pipeline=RGBAvatarPipelineConfig(
            model=RGBAvatarModelConfig(
                avatar=AvatarConfig(uv_resolution=128, scale_from_texel_spacing=True),
                lpips_metric=False,
            )
        ),
        max_num_iterations=1500,
        # Falling rates bring .2 to .3 dB on held-out frames of the demo subject. Their length is
        # named, so that a run resumed with more steps equals one that had them from the start.
        position_lr_final=8e-5,
        learning_rate_factor=0.1,
        learning_rate_steps=1500,
        steps_per_save=250,
        steps_per_eval_batch=500,
        steps_per_eval_image=500,
        steps_per_eval_all_images=1_000_000,
        optimizers=paper_optimizers(),
        machine=_machine(),
        logging=_logging(),
        viewer=_viewer(),
        vis="viewer+tensorboard",
    ),
    description="RGBAvatar with fewer Gaussians and steps: minutes on a CPU.",
)
