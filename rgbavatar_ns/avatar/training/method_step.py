"""One optimiser step of any method, eagerly: what the protocol of `AvatarMethod` asks for."""

from collections.abc import Callable, Iterable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.method import (
    AvatarMethod,
    DrawnBatch,
    FilmedBatch,
    Losses,
    WatchedStep,
)
from rgbavatar_ns.avatar.refinement.frames import FrameRefinement
from rgbavatar_ns.avatar.training.batches import ChosenFrames, TrainingBatch
from rgbavatar_ns.avatar.training.losses import random_backgrounds, require_images_of
from rgbavatar_ns.avatar.training.optimizer_states import take_steps
from rgbavatar_ns.avatar.training.step import StepKind
from rgbavatar_ns.drawing.compositing import film_over, is_unfilmed, rgba_to_float
from rgbavatar_ns.kernels import rasterize

Logged = Callable[[int, Mapping[str, float]], None]
"""Told of what a method says of itself after a step."""


def method_optimizers(method: AvatarMethod) -> list[torch.optim.Optimizer]:
    """Adam for each parameter group, with the method's learning rates; epsilon as 3DGS's."""
    rates = method.learning_rates()
    return [
        # Fused: on a CPU an eighth of the time of one tensor operation after another.
        torch.optim.Adam(parameters, lr=rates[name], eps=1e-15, fused=True)
        for name, parameters in method.parameter_groups().items()
    ]


class MethodStep:
    """Trains a method in place, a batch a call.

    Args:
        method: what is trained.
        optimizers: those that hold its parameters; by default `method_optimizers`.
        seed: of random backgrounds, and of what the method draws between steps.
        refinement: corrects the frames' theta by the gradient that each step leaves there.
        backend: of the rasterizer.
        logged: told of the figures that `before_next_step` and `after_step` return.
    """

    kind: StepKind = "eager"
    reason = "this method goes through autograd"

    def __init__(
        self,
        method: AvatarMethod,
        optimizers: Iterable[torch.optim.Optimizer] | None = None,
        *,
        seed: int = 0,
        refinement: FrameRefinement | None = None,
        backend: str = "auto",
        logged: Logged = lambda step, figures: None,
    ) -> None:
        self.method, self.refinement = method, refinement
        self.optimizers = list(method_optimizers(method) if optimizers is None else optimizers)
        self._seed, self._backend, self._logged = seed, backend, logged
        groups = method.parameter_groups()
        self._name_of = {p: name for name, group in groups.items() for p in group}

    def __call__(self, batch: TrainingBatch | ChosenFrames, step: int) -> Losses:
        """Do what is due after the step before and take `step`; the parts of the loss, detached.

        Raises ValueError for `ChosenFrames`, which only recorded steps take.
        """
        if isinstance(batch, ChosenFrames):
            raise ValueError(f"Steps are {self.kind}: {self.reason}. Pass a TrainingBatch.")
        count, theta = len(batch.theta), batch.theta
        require_images_of(batch.images_rgba, count, batch.cameras)
        if step > 0:
            before = step - 1
            self._log(before, self.method.before_next_step(self.optimizers, before, self._seed))
        if self.refinement is not None:
            theta = self.refinement.begin(theta, batch.position)
        background = batch.background
        if background is None:
            background = random_backgrounds(step, count, self._seed)
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)
        losses, drawn, offset = self._losses(batch, theta, background.to(theta), step)
        torch.stack(list(losses.values())).sum().backward()
        self._set_rates(step)
        take_steps(self.optimizers)
        if self.refinement is not None:
            self.refinement.learn(step, theta, batch.position)
        watched = None
        if offset is not None and offset.grad is not None:
            watched = WatchedStep(drawn.gaussians, batch.cameras, offset.grad)
        self._log(step, self.method.after_step(watched, self.optimizers, step, self._seed))
        return {name: loss.detach() for name, loss in losses.items()}

    def _log(self, step: int, figures: Mapping[str, float]) -> None:
        if figures:
            self._logged(step, figures)

    def _set_rates(self, step: int) -> None:
        factors = self.method.rate_factors(step)
        for group in (group for o in self.optimizers for group in o.param_groups):
            name = self._name_of[group["params"][0]]
            if name in factors:
                # Kept with the optimiser's state, so that a resumed run multiplies the same.
                group["lr"] = group.setdefault("first_lr", group["lr"]) * factors[name]

    def look_back(self, frames: Iterable[TrainingBatch]) -> bool:
        """As `TrainingStep.look_back`: there is nothing to do."""
        return False

    def _losses(
        self,
        batch: TrainingBatch,
        theta: Float[Tensor, "B H"],
        background: Float[Tensor, "B 3"],
        step: int,
    ) -> tuple[Losses, DrawnBatch, Float[Tensor, "B N 2"] | None]:
        """The parts of the loss with their graph, what was drawn, and where its means moved to."""
        method, cameras, offset = self.method, batch.cameras, None
        gaussians = method.gaussians(theta, cameras=cameras)
        if method.watches(step):
            size = (len(theta), gaussians.means.shape[1], 2)
            offset = gaussians.means.new_zeros(size).requires_grad_()
        rendered = rasterize(
            gaussians, cameras, background, backend=self._backend, screen_offset=offset
        )
        drawn = DrawnBatch(theta, cameras, gaussians, rendered.image, rendered.alpha)
        filmed = FilmedBatch(
            batch.images_rgba,
            background,
            film_over(batch.images_rgba, background, rendered.image.detach()),
            rgba_to_float(batch.images_rgba, background.dtype)[..., 3:],
            is_unfilmed(batch.images_rgba),
        )
        losses = method.image_losses(drawn, filmed, step) | method.penalty(drawn, step)
        return losses, drawn, offset
