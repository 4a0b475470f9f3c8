"""Options that would change nothing: refused by name instead of ignored."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

from nerfstudio.engine.trainer import TrainerConfig

from rgbavatar_ns.avatar.storage.checkpoint_file import MODELS_FOLDER
from rgbavatar_ns.errors import UserError

_LEAVE_OUT = "Leave it out."


@dataclass(frozen=True)
class Refused:
    """An option that only counts for other methods, unless it is one of the values `taken`."""

    option: str
    taken: tuple[Any, ...]
    because: str
    remedy: str = _LEAVE_OUT


_ONE_DEVICE = "this method trains on one device of one machine"
_FLOAT32 = "the rasterizer computes in float32, which needs no scaling of gradients"
REFUSED = (
    Refused(
        "gradient_accumulation_steps",
        ({},),
        "every step of this method ends with a step of all its optimizers",
        "Leave it out; --pipeline.datamanager.batch-size takes more images in a step.",
    ),
    Refused(
        "log_gradients",
        (False,),
        "the steps take gradients straight into Adam and hold none to log",
    ),
    Refused("mixed_precision", (False,), _FLOAT32),
    Refused("use_grad_scaler", (False,), _FLOAT32),
    Refused("prompt", (None,), "this method learns from a film, not from words"),
    Refused("pipeline.model.prompt", (None,), "this method learns from a film, not from words"),
    Refused("pipeline.model.enable_collider", (False,), "no rays are traced, so none collide"),
    Refused("machine.num_machines", (1,), _ONE_DEVICE),
    Refused("machine.machine_rank", (0,), _ONE_DEVICE),
    Refused("machine.dist_url", ("auto",), _ONE_DEVICE),
    Refused(
        "logging.profiler",
        ("none", "basic"),
        "it traces nerfstudio's own training step, which this method replaces",
        "Leave it out; `rgbavatar bench step` times the step by part.",
    ),
    Refused(
        # -1 is what ns-viewer brings.
        "viewer.num_rays_per_chunk",
        (32768, -1),
        "whole images are drawn, not chunks of rays",
    ),
    Refused(
        "relative_model_dir",
        (Path(MODELS_FOLDER),),
        "the project's other commands find a run's checkpoints by that name",
        "Leave it out; --output-dir chooses the place of the run.",
    ),
)


@dataclass(frozen=True)
class Dependent:
    """An option that only counts beside another one; the preset's own value is passed over."""

    option: str
    counts: Callable[[Any], bool]
    because: str
    remedy: str


def _rates_fall(config: Any) -> bool:
    return config.position_lr_final is not None or config.learning_rate_factor != 1.0


def _rates_fall_or_bases_wait(config: Any) -> bool:
    model = config.pipeline.model
    return _rates_fall(config) or (model.refine_tracking and model.refinement.bases_start > 0)


_NO_RATE_FALLS = "no learning rate is to fall"
_LET_FALL = "Leave it out, or name --learning-rate-factor or --position-lr-final."
DEPENDENT = (
    Dependent("learning_rate_steps", _rates_fall_or_bases_wait, _NO_RATE_FALLS, _LET_FALL),
    Dependent("learning_rate_decay", _rates_fall, _NO_RATE_FALLS, _LET_FALL),
    Dependent(
        "pipeline.model.first_colors",
        lambda config: config.pipeline.model.initialize_colors,
        "first colours are off",
        "Leave it out, or --pipeline.model.initialize-colors False.",
    ),
    Dependent(
        "pipeline.model.lpips_start_step",
        lambda config: config.pipeline.model.lpips_weight > 0,
        "the LPIPS loss has no weight",
        "Leave it out, or name --pipeline.model.lpips-weight.",
    ),
    Dependent(
        "pipeline.model.refine_held_out_frames",
        lambda config: config.pipeline.model.refine_held_out > 0,
        "held-out frames are not fitted",
        "Leave it out, or name --pipeline.model.refine-held-out.",
    ),
)


def require_rates_to_fall(config: Any, groups: Collection[str], scheduled: Collection[str]) -> None:
    """Raise UserError where rates are to fall that the method has not, or lets fall by itself."""
    final, factor = config.position_lr_final, config.learning_rate_factor
    if final is not None and ("position" in scheduled or "position" not in groups):
        own = "the method lets that rate fall by itself"
        because = own if "position" in groups else "the method learns no positions by that name"
        raise UserError(f"--position-lr-final is {final}, but {because}.", _LEAVE_OUT)
    if factor != 1.0 and set(groups) <= set(scheduled):
        because = "the method lets all of its rates fall by itself"
        raise UserError(f"--learning-rate-factor is {factor}, but {because}.", _LEAVE_OUT)


def require_bases_to_begin(config: Any, groups: Collection[str]) -> None:
    """Raise UserError where bases would wait for a share of steps that nobody knows the number of.

    A run that ends by the clock takes as many as the machine makes of its seconds.
    """
    model, seconds = config.pipeline.model, config.max_train_seconds
    if seconds is None or config.learning_rate_steps is not None or not model.refine_tracking:
        return
    if any(model.refinement.first_step_of(name, config.max_num_iterations) for name in groups):
        raise UserError(
            f"--max-train-seconds is {seconds}, but with refined tracking bases begin to learn "
            "after a share of the steps, which may be more than the seconds allow for.",
            "Say by --learning-rate-steps about how many steps they make.",
        )


def require_used(config: TrainerConfig) -> None:
    """Raise UserError for an option that would change nothing, or wait for ever."""
    for refused in REFUSED:
        value = _value(config, refused.option)
        if value not in refused.taken:
            option = "--" + refused.option.replace("_", "-")
            raise UserError(f"{option} is {value}, but {refused.because}.", refused.remedy)
    for dependent in DEPENDENT:
        value = _value(config, dependent.option)
        if value is None or dependent.counts(config):
            continue
        if value != _value(_preset_of(config), dependent.option):
            option = "--" + dependent.option.replace("_", "-")
            raise UserError(f"{option} is {value}, but {dependent.because}.", dependent.remedy)
    if config.vis == "viewer_legacy":
        raise UserError(
            "--vis is viewer_legacy, but this method has its panel in nerfstudio's newer viewer.",
            "Take --vis viewer, or viewer+tensorboard.",
        )
    if config.start_paused and not config.is_viewer_enabled():
        raise UserError(
            "--start-paused waits for the viewer's button, and --vis is without a viewer.",
            "Leave it out, or take --vis viewer+tensorboard.",
        )


def _value(config: Any, option: str) -> Any:
    """An option's value; None where the method has no such option."""
    return reduce(lambda part, name: getattr(part, name, None), option.split("."), config)


def _preset_of(config: TrainerConfig) -> TrainerConfig:
    """The method's config as nerfstudio lists it; the defaults of one that it does not list."""
    # Its list imports this plugin, whose trainer imports this file.
    from nerfstudio.configs.method_configs import all_methods

    name = config.method_name
    return all_methods[name] if name in all_methods else type(config)()
