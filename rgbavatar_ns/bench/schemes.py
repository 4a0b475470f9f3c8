"""The paper's training schemes: what is done with a batch, ready to be timed again and again."""

from collections.abc import Callable
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.training.loop import (
    TrainingBatch,
    TrainingOptions,
    make_optimizer,
    training_step,
)
from rgbavatar_ns.avatar.training.losses import l1_loss, random_backgrounds
from rgbavatar_ns.avatar.training.recorded_step import (
    DeviceFrames,
    RecordedStep,
    Recorder,
    record_cuda_graph,
)
from rgbavatar_ns.bench.options import Scheme
from rgbavatar_ns.bench.projection import one_camera
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float

WHOLE_STEP = "whole step"
EAGER_STEP = "whole step, eager"
UNRECORDED_STEP = "whole step, not recorded"
TOGETHER_STEP = "whole step, eager, images drawn together"

Take = Callable[[Avatar, torch.optim.Optimizer, TrainingBatch, TrainingOptions], Tensor]


class Step(Protocol):
    """What is done with one batch, from the same parameters each time."""

    def run(self) -> Float[Tensor, ""]:
        """Do it and return the mean loss."""
        ...

    def restore(self) -> None:
        """Put the parameters back; the optimiser's moments stay, which changes no time."""
        ...


class WholeStep:
    """A batch's training, by torch's optimiser or the backend's loops."""

    def __init__(
        self,
        avatar: Avatar,
        batch: TrainingBatch,
        options: TrainingOptions,
        scheme: Scheme = "batch-parallel",
    ) -> None:
        self._avatar, self._batch, self._options = avatar, batch, options
        self._take = _SCHEMES[scheme]
        self.optimizer = make_optimizer(avatar)
        self._start = _Start(avatar)

    def run(self) -> Float[Tensor, ""]:
        """See `Step`."""
        return self._take(self._avatar, self.optimizer, self._batch, self._options)

    def restore(self) -> None:
        """See `Step`."""
        self._start.restore()


class RecordedScheme:
    """A batch's training by one recorded CUDA graph, which is recorded when this is made."""

    _STEPS_BEFORE = 8

    def __init__(
        self, avatar: Avatar, batch: TrainingBatch, recorder: Recorder = record_cuda_graph
    ) -> None:
        self._start = _Start(avatar)
        frames = DeviceFrames(batch.theta, batch.cameras, torch.as_tensor(batch.images_rgba))
        count = len(batch.theta)
        optimizers = [make_optimizer(avatar)]
        self._step = RecordedStep(avatar, optimizers, frames, count, recorder=recorder)
        self._chosen, self._background = list(range(count)), random_backgrounds(0, count)
        for _ in range(self._STEPS_BEFORE):
            self.run()
        self.restore()

    def run(self) -> Float[Tensor, ""]:
        """See `Step`."""
        return self._step(self._chosen, self._background)

    def restore(self) -> None:
        """See `Step`."""
        self._start.restore()


class _Start:
    """The parameters as they were."""

    def __init__(self, avatar: Avatar) -> None:
        self._parameters = parameters_of(avatar)
        self._before = [parameter.detach().clone() for parameter in self._parameters]

    @torch.no_grad()
    def restore(self) -> None:
        for parameter, before in zip(self._parameters, self._before):
            parameter.copy_(before)


def parameters_of(avatar: Avatar) -> list[nn.Parameter]:
    """All that is trained."""
    return [parameter for group in avatar.parameter_groups().values() for parameter in group]


def steps_of(scheme: Scheme, avatar: Avatar, batch: TrainingBatch) -> dict[str, Callable[[], Step]]:
    """What makes the scheme's step, the fastest that there is here, and those beside it."""
    fast, eager = TrainingOptions(color_init=None), TrainingOptions(color_init=None, fast=False)

    def whole(options: TrainingOptions, scheme: Scheme) -> Callable[[], Step]:
        return lambda: WholeStep(avatar, batch, options, scheme)

    if scheme == "naive-batch":
        return {WHOLE_STEP: whole(eager, scheme), TOGETHER_STEP: whole(eager, "batch-parallel")}
    if scheme == "batch-parallel" and batch.theta.device.type == "cuda":
        return {
            WHOLE_STEP: lambda: RecordedScheme(avatar, batch),
            UNRECORDED_STEP: whole(fast, scheme),
            EAGER_STEP: whole(eager, scheme),
        }
    return {WHOLE_STEP: whole(fast, scheme), EAGER_STEP: whole(eager, scheme)}


def _step_together(
    avatar: Avatar,
    optimizer: torch.optim.Optimizer,
    batch: TrainingBatch,
    options: TrainingOptions,
) -> Tensor:
    return training_step(avatar, optimizer, batch, 0, options)


def _step_after_drawing_one_by_one(
    avatar: Avatar,
    optimizer: torch.optim.Optimizer,
    batch: TrainingBatch,
    options: TrainingOptions,
) -> Tensor:
    """The same step up to rounding, as `batch_parallel=False` of the plugin's model."""
    optimizer.zero_grad(set_to_none=True)
    count, dtype = len(batch.theta), avatar.blendshapes.position.dtype
    backgrounds = random_backgrounds(0, count, options.seed).to(batch.theta.device, dtype)
    whole = torch.zeros((), dtype=dtype, device=batch.theta.device)
    for position in range(count):
        one, background = _one_frame(batch, position), backgrounds[position : position + 1]
        image = avatar.render(one.theta, one.cameras, background).image
        target = composite(rgba_to_float(one.images_rgba, dtype), background)
        loss = l1_loss(image, target) / count
        loss.backward()
        whole += loss.detach()
    optimizer.step()
    return whole


def _step_by_step(
    avatar: Avatar,
    optimizer: torch.optim.Optimizer,
    batch: TrainingBatch,
    options: TrainingOptions,
) -> Tensor:
    """As many steps as images."""
    losses = [
        training_step(avatar, optimizer, _one_frame(batch, position), position, options)
        for position in range(len(batch.theta))
    ]
    return torch.stack(losses).mean()


_SCHEMES: dict[Scheme, Take] = {
    "batch-parallel": _step_together,
    "naive-batch": _step_after_drawing_one_by_one,
    "single": _step_by_step,
}


def _one_frame(batch: TrainingBatch, position: int) -> TrainingBatch:
    place = slice(position, position + 1)
    cameras = one_camera(batch.cameras, position)
    return TrainingBatch(batch.theta[place], cameras, batch.images_rgba[place])
