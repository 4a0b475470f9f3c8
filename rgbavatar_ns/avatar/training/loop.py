"""The training loop: offline, online, under nerfstudio or without it."""

import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.training.batches import ChosenFrames, TrainingBatch
from rgbavatar_ns.avatar.training.method_step import MethodStep
from rgbavatar_ns.avatar.training.step import Losses, TrainingStep


class FitHooks:
    """What a run does around its steps; by itself nothing."""

    def goes_on(self, step: int) -> bool:
        """Whether to take `step`; may wait. False ends the training."""
        return True

    def around_step(self, step: int) -> AbstractContextManager[object]:
        """What is held while a batch is fetched and its step is taken."""
        return nullcontext()

    def after_step(self, step: int, losses: Losses, seconds: float) -> None:
        """What follows: progress, curves, evaluation, checkpoints."""


class LossCurve(FitHooks):
    """Keeps the loss of each step, without waiting for the device."""

    def __init__(self, steps: int) -> None:
        # One tensor for all: a small one kept from each step would split the allocator's large
        # free blocks, and the process would grow by about an image batch a step.
        self._losses, self._taken = torch.zeros(steps), 0

    @property
    def losses(self) -> Float[Tensor, "steps"]:
        """One value a step taken so far."""
        return self._losses[: self._taken]

    def after_step(self, step: int, losses: Losses, seconds: float) -> None:
        """See `FitHooks`."""
        self._losses[self._taken] = torch.stack(list(losses.values())).sum()
        self._taken += 1


def fit(
    take: TrainingStep | MethodStep,
    batch_at: Callable[[int], TrainingBatch | ChosenFrames],
    steps: Iterable[int],
    hooks: FitHooks | None = None,
) -> None:
    """Train in place: for each number of `steps`, fetch its batch and take its step.

    `batch_at(step)` gives the batch; being asked by number, it can be a pure function, and a run
    in pieces (the same optimisers, numbers that go on) equals a run in one. Raises UserError where
    an LPIPS loss is asked for but unavailable.
    """
    hooks = FitHooks() if hooks is None else hooks
    for step in steps:
        if not hooks.goes_on(step):
            return
        began = time.monotonic()
        with hooks.around_step(step):
            losses = take(batch_at(step), step)
        hooks.after_step(step, losses, time.monotonic() - began)
