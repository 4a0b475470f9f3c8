"""The training step and a minimal loop around it: the paper's offline training in one function."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.avatar import LEARNING_RATES, Avatar
from rgbavatar_ns.avatar.training.color_init import ColorInitSchedule
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.losses import (
    LPIPSLoss,
    composite,
    l1_loss,
    random_backgrounds,
    rgba_to_float,
)
from rgbavatar_ns.avatar.training.optimizer_states import unsupported_reason
from rgbavatar_ns.kernels import PinholeCameras


@dataclass(frozen=True)
class TrainingBatch:
    """B tracked frames: theta, cameras (one, or one an image) and straight-alpha images."""

    theta: Float[Tensor, "B H"]
    cameras: PinholeCameras
    images_rgba: UInt8[Tensor, "B H_px W_px 4"] | Float[Tensor, "B H_px W_px 4"]


@dataclass(frozen=True)
class TrainingOptions:
    """What the paper leaves to choose about training."""

    seed: int = 0
    """Seed of the random backgrounds."""
    lpips_weight: float = 0.0
    """Weight of the LPIPS loss (paper's variant: .05); 0 needs no LPIPS network."""
    lpips_start_step: int = 0
    """First step with the LPIPS loss (release: after 20k images)."""
    color_init: ColorInitSchedule | None = field(default_factory=ColorInitSchedule)
    """When colours are initialised; None leaves them grey."""
    fast: bool = True
    """Use the fused step where it can be; False keeps to the readable path through autograd."""


def make_optimizer(
    avatar: Avatar, learning_rates: dict[str, float] | None = None
) -> torch.optim.Adam:
    """Return Adam over the avatar's parameter groups, with the paper's learning rates.

    Epsilon 1e-15 as the release and 3DGS: gradients of single Gaussians are far below Adam's
    default of 1e-8. Fused: four times faster on a CPU.
    """
    rates = LEARNING_RATES | (learning_rates or {})
    groups = [
        {"name": name, "params": parameters, "lr": rates[name]}
        for name, parameters in avatar.parameter_groups().items()
    ]
    return torch.optim.Adam(groups, eps=1e-15, fused=True)


def training_loss(
    avatar: Avatar,
    batch: TrainingBatch,
    step: int,
    options: TrainingOptions,
    lpips: LPIPSLoss | None = None,
) -> Float[Tensor, ""]:
    """Render the batch over random backgrounds and return its loss (paper, sec. 3.2)."""
    device, dtype = batch.theta.device, avatar.blendshapes.position.dtype
    background = random_backgrounds(step, len(batch.theta), options.seed).to(device, dtype)
    image = avatar.render(batch.theta, batch.cameras, background).image
    target = composite(rgba_to_float(batch.images_rgba, dtype), background)
    loss = l1_loss(image, target)
    if lpips is not None and options.lpips_weight > 0 and step >= options.lpips_start_step:
        loss = loss + options.lpips_weight * lpips(image, target)
    return loss


def initialize_colors_if_due(
    avatar: Avatar, batch: TrainingBatch, step: int, schedule: ColorInitSchedule | None
) -> int:
    """After an optimiser step, initialise colours when the schedule says so; return how many."""
    if schedule is None or not schedule.due(step) or bool(avatar.color_initialized.all()):
        return 0
    return avatar.initialize_colors(batch.theta, batch.cameras, batch.images_rgba)


def training_step(
    avatar: Avatar,
    optimizer: torch.optim.Optimizer,
    batch: TrainingBatch,
    step: int,
    options: TrainingOptions,
    lpips: LPIPSLoss | None = None,
) -> Float[Tensor, ""]:
    """Take one optimiser step, then initialise colours where due; return the detached loss."""
    loss = _fused_loss(avatar, optimizer, batch, step, options) if options.fast else None
    if loss is None:
        optimizer.zero_grad(set_to_none=True)
        loss = training_loss(avatar, batch, step, options, lpips)
        loss.backward()
        optimizer.step()
    initialize_colors_if_due(avatar, batch, step, options.color_init)
    return loss.detach()


def _fused_loss(
    avatar: Avatar,
    optimizer: torch.optim.Optimizer,
    batch: TrainingBatch,
    step: int,
    options: TrainingOptions,
) -> Float[Tensor, ""] | None:
    """The loss of a fused step; None where it has not been taken."""
    with_lpips = options.lpips_weight > 0 and step >= options.lpips_start_step
    if with_lpips or batch.images_rgba.dtype != torch.uint8:
        return None
    if unsupported_reason(avatar, [optimizer]) is not None:
        return None
    background = random_backgrounds(step, len(batch.theta), options.seed)
    background = background.to(batch.theta.device, avatar.blendshapes.position.dtype)
    return FusedStep(avatar, [optimizer])(batch.theta, batch.cameras, batch.images_rgba, background)


def fit(
    avatar: Avatar,
    batch_at: Callable[[int], TrainingBatch],
    steps: int,
    options: TrainingOptions | None = None,
    *,
    optimizer: torch.optim.Optimizer | None = None,
    first_step: int = 0,
    on_step: Callable[[int, Tensor], None] | None = None,
) -> Float[Tensor, "steps"]:
    """Train in place for `steps` steps and return each step's loss.

    `batch_at(step)` gives the batch; being asked by number, it can be a pure function, and a run
    in pieces (same optimizer, `first_step` going on) equals a run in one. `on_step(step, loss)`
    is called after each step. Raises UserError where an LPIPS loss is asked for but unavailable.
    """
    options = TrainingOptions() if options is None else options
    optimizer = make_optimizer(avatar) if optimizer is None else optimizer
    lpips = LPIPSLoss() if options.lpips_weight > 0 else None
    # One tensor for all: a small one kept from each step would split the allocator's large free
    # blocks, and the process would grow by about an image batch a step.
    losses = torch.zeros(steps)
    for step in range(first_step, first_step + steps):
        loss = training_step(avatar, optimizer, batch_at(step), step, options, lpips)
        losses[step - first_step] = loss
        if on_step is not None:
            on_step(step, loss)
    return losses
