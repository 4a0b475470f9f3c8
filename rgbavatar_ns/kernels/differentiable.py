"""A compiled backend's drawing behind torch's autograd."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rgbavatar_ns.kernels.types import GaussianSet


class Drawn(NamedTuple):
    """What a backward pass may start from: it takes the remainder from the image, or what is
    behind the Gaussians from the background."""

    background: Tensor
    image: Tensor
    alpha: Tensor


Gradients = Callable[[tuple[Tensor, ...], Drawn, Tensor | None, Tensor | None], list[Tensor]]
"""From `gaussian_inputs`, what was drawn and the gradients of image and alpha to the inputs' own,
in their shapes. It must not hold image or alpha, which hold it."""

Draw = Callable[[tuple[Tensor, ...], Tensor], tuple[Tensor, Tensor, Gradients]]
"""Draws `gaussian_inputs`, contiguous, over a background: image, alpha, and how they are
differentiated."""


def gaussian_inputs(
    gaussians: GaussianSet, screen_offset: Tensor | None = None
) -> tuple[Tensor, ...]:
    """Means, quats_wxyz, scales, opacities, colors and, where it is given, the screen offset."""
    attributes = (
        gaussians.means,
        gaussians.quats_wxyz,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
    )
    return attributes if screen_offset is None else (*attributes, screen_offset)


def draw_differentiably(draw: Draw, *inputs: Tensor) -> tuple[Tensor, Tensor]:
    """Image and alpha of `gaussian_inputs`, then the background."""
    return _Drawn.apply(draw, *inputs)


class _Drawn(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, draw: Draw, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        *gaussians, background = (tensor.detach().contiguous() for tensor in inputs)
        image, alpha, gradients = draw(tuple(gaussians), background)
        if any(ctx.needs_input_grad):
            ctx.gradients = gradients
            ctx.save_for_backward(*gaussians, background, image, alpha)
            ctx.set_materialize_grads(False)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        image_grad, alpha_grad = (None if g is None else g.contiguous() for g in grad_outputs)
        *gaussians, background, image, alpha = ctx.saved_tensors
        if image_grad is None and alpha_grad is None:
            return (None,) * len(ctx.needs_input_grad)
        grads: list[Tensor | None] = [None] * len(gaussians)
        needed = ctx.needs_input_grad[1:-1]
        if any(needed):
            drawn = Drawn(background, image, alpha)
            filled = ctx.gradients(tuple(gaussians), drawn, image_grad, alpha_grad)
            grads = [grad if wanted else None for grad, wanted in zip(filled, needed)]
        background_grad = None
        if ctx.needs_input_grad[-1] and image_grad is not None:
            background_grad = ((1 - alpha) * image_grad).sum((1, 2))
            background_grad = background_grad.sum_to_size(background.shape)
        return (None, *grads, background_grad)
