"""What a step tells: its loss, looked at, and TensorBoard's curves."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName

from rgbavatar_ns.avatar.training.step import Losses
from rgbavatar_ns.errors import UserError


def finite_loss(
    losses: Losses, step: int, optimizers: Mapping[str, Any], checkpoint_dir: Path
) -> float:
    """Return the whole loss; raises UserError where it is not finite.

    It tells what to change, by the `optimizers` of the config, and to resume from
    `checkpoint_dir`.
    """
    loss = sum(map(float, losses.values()))
    if not math.isfinite(loss):
        changed = "smaller learning rates, for example --optimizers.color.optimizer.lr 0.005"
        if not optimizers:  # the method's own rates
            changed = "other options of the method, --pipeline.model.avatar.*"
        raise UserError(
            f"The loss of step {step} is {loss}.",
            f"Resume from the last checkpoint in {checkpoint_dir} with {changed}.",
        )
    return loss


def write_step(
    step: int, loss: float, losses: Losses, *, images: int, pixels: int, seconds: float
) -> None:
    """Write a step's losses, and its speed from its images, their pixels and its seconds."""
    writer.put_scalar(name="Train Loss", scalar=loss, step=step)
    writer.put_dict(name="Train Loss Dict", scalar_dict={**losses}, step=step)
    writer.put_scalar(name="Train Images / Sec", scalar=images / seconds, step=step)
    writer.put_time(EventName.ITER_TRAIN_TIME, seconds, step, update_eta=True)
    writer.put_time(EventName.TRAIN_RAYS_PER_SEC, pixels / seconds, step)


def write_rates(step: int, schedulers: Mapping[str, Any]) -> None:
    """Write the learning rates that follow a schedule."""
    for name, scheduler in schedulers.items():
        rate = scheduler.get_last_lr()[0]
        writer.put_scalar(name=f"learning_rate/{name}", scalar=rate, step=step)
