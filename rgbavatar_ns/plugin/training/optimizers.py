"""Adam and learning-rate schedules whose checkpoints hold nothing but tensors and numbers."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import torch
from nerfstudio.engine.optimizers import OptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.nn import Parameter
from torch.optim.lr_scheduler import LambdaLR

from rgbavatar_ns.avatar import LEARNING_RATES
from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.options import Between, Counted, Positive, Weight
from rgbavatar_ns.plugin.training.refused import require_bases_to_begin, require_rates_to_fall

DecayShape = Literal["exponential", "linear"]
_MOMENTS = ("exp_avg", "exp_avg_sq")
_MAX_STEP = 1 << 40
_ASKED, _RATES = "asked_lr", ("lr", "initial_lr", "first_lr")


@dataclass
class AdamConfig(OptimizerConfig):
    """Adam with one pass over memory per step."""

    _target: type = torch.optim.Adam
    lr: Weight = 1e-3
    """Learning rate per step."""
    eps: Annotated[float, Between(0, 1)] = 1e-15
    """Added to the root of the second moment; tiny, as in Gaussian splatting."""
    max_norm: Positive | None = None
    """Largest norm of a group's gradient; unlimited by default."""
    fused: bool = True
    """Use PyTorch's fused kernel, on a CPU too."""


@dataclass
class DecayConfig(SchedulerConfig):
    """Nothing before `start_step`; from the optimizer's rate at step 0 to `factor` times it at
    step `steps`, then constant.

    nerfstudio's own schedules compute with numpy, whose scalars end up in the checkpoint and
    make it unreadable for torch's safe loading.
    """

    _target: type = field(default_factory=lambda: Decay)
    factor: Annotated[float, Between(1e-9, 1e3)] = 1.0
    """Final learning rate divided by the first one."""
    steps: Counted = 5000
    """Steps until the final rate is reached."""
    start_step: Counted = 0
    """First step with a rate that is not zero."""
    shape: DecayShape = "exponential"
    """Whether each step takes the same share of the rate, or the same amount."""


class Decay(Scheduler):
    """The schedule of `DecayConfig`."""

    config: DecayConfig

    def get_scheduler(self, optimizer: torch.optim.Optimizer, lr_init: float) -> LambdaLR:
        """Torch's scheduler for `optimizer`; `lr_init` is taken from the optimizer itself."""
        return LambdaLR(optimizer, _share_of(self.config))


def _share_of(config: DecayConfig) -> Callable[[int], float]:
    """From a step to what the first rate is multiplied by.

    A function, because torch would store another callable's fields, and a run that goes on load
    them in place of what is asked for now.
    """
    factor, steps, linear = config.factor, max(1, config.steps), config.shape == "linear"

    def share(step: int) -> float:
        passed = min(step / steps, 1.0)
        falling = 1 + (factor - 1) * passed if linear else factor**passed
        return falling if step >= config.start_step else 0.0

    return share


def paper_optimizers() -> dict[str, Any]:
    """One Adam a parameter group at the paper's constant learning rates (supplement, table)."""
    return {
        name: {"optimizer": AdamConfig(lr=rate), "scheduler": None}
        for name, rate in LEARNING_RATES.items()
    }


def scheduled_optimizers(
    config: Any, groups: dict[str, list[Parameter]], avatar: AvatarMethod
) -> Optimizers:
    """Return an optimiser a parameter group, with the schedules that a trainer's config asks for.

    Raises UserError where the config asks for what would change nothing.
    """
    steps = config.learning_rate_steps or config.max_num_iterations
    # Of a run that is shorter than its schedule, the bases are to learn too.
    refined = min(steps, config.max_num_iterations)
    model = config.pipeline.model
    settings: dict[str, Any] = {}
    rates, scheduled = avatar.learning_rates(), avatar.rate_factors(0).keys()
    require_rates_to_fall(config, groups.keys(), scheduled)
    require_bases_to_begin(config, groups.keys())
    for name in groups:
        own = {"optimizer": AdamConfig(lr=rates[name]), "scheduler": None}
        settings[name] = dict(config.optimizers.get(name, own))
        rate = settings[name]["optimizer"].lr
        factor = 1.0 if name in scheduled else config.learning_rate_factor
        if name == "position" and config.position_lr_final is not None:
            # Positions that are kept still (a rate of 0) stay so.
            factor = config.position_lr_final / rate if rate > 0 else 1.0
        start = model.refinement.first_step_of(name, refined) if model.refine_tracking else 0
        if (factor != 1.0 or start > 0) and settings[name].get("scheduler") is None:
            settings[name]["scheduler"] = DecayConfig(
                factor=factor, steps=steps, start_step=start, shape=config.learning_rate_decay
            )
    optimizers = Optimizers(settings, groups)
    _note_asked_rates(optimizers)
    return optimizers


def _note_asked_rates(optimizers: Optimizers) -> None:
    """Keep in each optimiser's state the rate that was asked for, before any schedule."""
    for name, optimizer in optimizers.optimizers.items():
        for group in optimizer.param_groups:
            group[_ASKED] = optimizers.config[name]["optimizer"].lr


def go_on_as_asked(optimizers: Optimizers, resumed: Collection[str], step: int) -> None:
    """Let loaded optimisers go on from `step` at the rates that the config asks for now.

    What a loaded state has done to its rate (schedules, a stream's end) stays done, times the new
    rate by the old one, and what has begun to learn goes on, though a longer run's schedule would
    begin later. `resumed` names the schedules that were loaded; others begin as if they had
    been there from the first step on.
    """
    for name, optimizer in optimizers.optimizers.items():
        adam, schedule = optimizers.config[name]["optimizer"], optimizers.schedulers.get(name)
        decay = optimizers.config[name]["scheduler"]
        for number, group in enumerate(optimizer.param_groups):
            if isinstance(decay, DecayConfig) and schedule is not None and name in resumed:
                begun = replace(decay, start_step=0)
                schedule.lr_lambdas[number] = _share_of(begun if group["lr"] > 0 else decay)
            before = group.get(_ASKED, group.get("initial_lr", group.get("first_lr", group["lr"])))
            if adam.lr != before:
                change = adam.lr / before if before > 0 else 0.0
                group |= {key: group[key] * change or adam.lr for key in _RATES if key in group}
                if schedule is not None and name in resumed:
                    schedule.base_lrs[number] = adam.lr
            group |= {_ASKED: adam.lr, "eps": adam.eps}
            if schedule is None and group.pop("initial_lr", None) is not None:
                group["lr"] = adam.lr
            if schedule is not None and name not in resumed:
                schedule.last_epoch = step
                share = schedule.lr_lambdas[number](step)
                group |= {"initial_lr": adam.lr, "lr": adam.lr * share}


def require_fitting_states(optimizers: Iterable[torch.optim.Optimizer]) -> None:
    """Raise ValueError where a loaded Adam's moments are none of its parameters'.

    torch takes any; the kernels that step without autograd rely on their shapes.
    """
    for optimizer in optimizers:
        if not isinstance(optimizer, torch.optim.Adam):
            continue
        for parameter, state in optimizer.state.items():
            shapes = {"step": torch.Size(), **dict.fromkeys(_MOMENTS, parameter.shape)}
            for name, shape in shapes.items():
                value = state.get(name)
                fits = isinstance(value, torch.Tensor) and value.is_floating_point()
                if not fits or value.shape != shape or not value.is_contiguous():
                    raise ValueError(f"an optimizer's {name} has not the shape {list(shape)}")
            if not 0 <= state["step"] < _MAX_STEP:
                raise ValueError("an optimizer has counted impossible steps")
