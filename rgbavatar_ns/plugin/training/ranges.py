"""Which options a run can begin with, nerfstudio's included, and on which data."""

import torch
from nerfstudio.configs.base_config import (
    LocalWriterConfig,
    LoggingConfig,
    MachineConfig,
    ViewerConfig,
)
from nerfstudio.engine.trainer import TrainerConfig

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import available_backends
from rgbavatar_ns.options import Between, Ranges, check_options
from rgbavatar_ns.plugin.training.checkpoints import checkpoint_of_step, require_checkpoints
from rgbavatar_ns.plugin.training.refused import require_used

_OFTEN = Between(1, 10**9)
_HOST_RANGES: Ranges = {
    TrainerConfig: dict.fromkeys(
        (
            "steps_per_save",
            "steps_per_eval_batch",
            "steps_per_eval_image",
            "steps_per_eval_all_images",
        ),
        _OFTEN,
    ),
    MachineConfig: {"seed": Between(0, 2**32 - 1), "num_devices": Between(1, 1)},
    LoggingConfig: {"steps_per_log": _OFTEN, "max_buffer_size": _OFTEN},
    LocalWriterConfig: {"max_log_size": Between(0, 10**9)},
    ViewerConfig: {
        "websocket_port": Between(1, 65535),
        "websocket_port_default": Between(1, 65535),
        "jpeg_quality": Between(1, 100),
        "max_num_display_images": Between(-1, 10**9),
        "camera_frustum_scale": Between(0, 1e6),
    },
}
"""Of what nerfstudio declares."""


def require_in_range(config: TrainerConfig) -> None:
    """Raise UserError for an option out of its range or without effect, on whichever machine."""
    check_options(type(config), vars(config), more=_HOST_RANGES)
    require_used(config)


def require_trainable(config: TrainerConfig) -> None:
    """Raise UserError as `require_in_range`, and for a device that this machine lacks."""
    require_in_range(config)
    device = config.machine.device_type
    if device == "mps" or (device == "cuda" and not torch.cuda.is_available()):
        raise UserError(
            f"PyTorch finds no device of the type '{device}' that this method runs on.",
            "Leave out --machine.device-type, or install the driver and a PyTorch with CUDA.",
        )
    _require_rasterizer(config.pipeline.model.rasterizer, device)  # type: ignore[attr-defined]


def require_found(config: TrainerConfig) -> None:
    """Raise UserError where there is nothing to train on, or no checkpoint to go on from."""
    config.pipeline.datamanager.require_trainable()  # type: ignore[attr-defined]
    if config.load_dir is not None and config.load_step is None:
        require_checkpoints(config.load_dir)
    named = config.load_checkpoint
    if config.load_dir is not None and config.load_step is not None:
        named = checkpoint_of_step(config.load_dir, config.load_step)
    if named is not None and not named.is_file():
        raise UserError(f"There is no checkpoint {named}.", "Check its name and folder.")


def _require_rasterizer(name: str, device: str) -> None:
    available = available_backends()
    if name != "auto" and name not in available:
        raise UserError(
            f"--pipeline.model.rasterizer is {name}, which cannot be used here (available: "
            f"{', '.join(available)}).",
            "Leave it out: auto takes the quickest that there is.",
        )
    if name in ("cpu", "cuda") and name != device:
        raise UserError(
            f"--pipeline.model.rasterizer is {name}, which does not draw on the device {device}.",
            f"Leave it out, or pass --machine.device-type {name}.",
        )
