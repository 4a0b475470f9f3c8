"""The compiled loops for morphed Gaussians."""

import os
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.autograd.graph import increment_version

from rgbavatar_ns.kernels.checks import (
    check_average_images,
    check_moments,
    check_sight,
    check_target_images,
)
from rgbavatar_ns.kernels.cpu import (
    INSTRUCTION_SET_VARIABLE,
    _native,  # pyright: ignore[reportMissingModuleSource]
)
from rgbavatar_ns.kernels.functional import checked_background
from rgbavatar_ns.kernels.types import (
    BASIS_ATTRIBUTES,
    TANGENT_VARIANTS,
    UPDATED_ATTRIBUTES,
    AdamParameter,
    FirstSight,
    MorphedGaussians,
    MorphedGradient,
    PinholeCameras,
    RenderedBatch,
    WeightedColors,
)


def native_gaussians(gaussians: MorphedGaussians) -> Any:
    """Morphed Gaussians as compiled code takes them; holds their memory."""
    tensors: dict[str, Any] = {
        name: None if value is None else value.detach().contiguous()
        for name, value in vars(gaussians).items()
        if name != "variant"
    }
    return _native.Morphed(**tensors, variant=TANGENT_VARIANTS.index(gaussians.variant))


def native_cameras(cameras: PinholeCameras) -> tuple[Tensor, Tensor, Tensor, int, int]:
    """Cameras as the arguments of a native session, from their tensors to the height."""
    return (
        cameras.world_to_camera.detach().contiguous(),
        cameras.focal_px.detach().contiguous(),
        cameras.principal_point_px.detach().contiguous(),
        cameras.width,
        cameras.height,
    )


class CpuMorphedRenderer:
    """See `kernels.morphed.MorphedRenderer`."""

    def __init__(
        self,
        gaussians: MorphedGaussians,
        weights: Float[Tensor, "B K"],
        vertices: Float[Tensor, "B V 3"],
        cameras: PinholeCameras,
    ) -> None:
        self._cameras, self._count = cameras, len(gaussians.position)
        self._weights = weights.detach().contiguous()
        self._vertices = vertices.detach().contiguous()
        self._has_gradient = False
        self._session = _native.MorphedSession(
            native_gaussians(gaussians),
            self._weights,
            self._vertices,
            *native_cameras(cameras),
            torch.get_num_threads(),
            os.environ.get(INSTRUCTION_SET_VARIABLE, ""),
        )

    def draw(
        self,
        background: Float[Tensor, "3"] | Float[Tensor, "#B 3"] | None = None,
        *,
        with_depth: bool = False,
        with_visibility: bool = False,
    ) -> RenderedBatch:
        """As `rasterize`, without gradients."""
        background = checked_background(self._weights, background, len(self._weights))
        batch, new = len(self._weights), self._weights.new_empty
        size = (batch, self._cameras.height, self._cameras.width)
        image, alpha = new(*size, 3), new(*size, 1)
        depth = new(*size, 1) if with_depth else None
        self._session.draw(background.detach().contiguous(), 0, image, alpha, depth)
        visibility = None
        if with_visibility:
            visibility = new(batch, self._count)
            self._average(None, None, None, visibility)
        return RenderedBatch(image, alpha, depth, visibility)

    def draw_one(self, place: int) -> RenderedBatch:
        """The set at a place of the batch by itself, over black."""
        if not 0 <= place < len(self._weights):
            raise ValueError(f"There is no set {place} among {len(self._weights)}.")
        new, size = self._weights.new_empty, (1, self._cameras.height, self._cameras.width)
        image, alpha = new(*size, 3), new(*size, 1)
        self._session.draw(self._weights.new_zeros(1, 3), place, image, alpha, None)
        return RenderedBatch(image, alpha)

    def weighted_color_average(self, images: Float[Tensor, "#B H W C"]) -> WeightedColors:
        """As `weighted_color_average`."""
        check_average_images(images, self._weights, self._cameras)
        new = self._weights.new_empty
        size = (len(self._weights), self._count)
        weighted_sum, weight_sum, max_weight = new(*size, images.shape[-1]), new(size), new(size)
        self._average(images.contiguous(), weighted_sum, weight_sum, max_weight)
        return WeightedColors(weighted_sum, weight_sum, max_weight)

    def _average(
        self,
        images: Tensor | None,
        weighted_sum: Tensor | None,
        weight_sum: Tensor | None,
        max_weight: Tensor,
    ) -> None:
        self._has_gradient = False  # its sums take the place of a loss's
        self._session.average(images, weighted_sum, weight_sum, max_weight)

    def forward_loss(
        self,
        images_rgba: UInt8[Tensor, "B H W 4"],
        background: Float[Tensor, "#B 3"],
        sight: FirstSight | None = None,
    ) -> Float[Tensor, ""]:
        """The mean absolute difference to straight-alpha images over the background.

        Pixels that are marked `UNFILMED_RGBA` differ by 0; the divisor is that of all pixels.
        """
        check_target_images(images_rgba, len(self._weights), self._cameras)
        seen: dict[str, Any] = {}
        if sight is not None:
            check_sight(sight, self._count, self._weights)
            seen = {"known": sight.known, "sums": sight.sums}
            seen["threshold"] = sight.threshold
            seen["sight_images"] = min(sight.num_images, len(self._weights))
            seen["over_background"] = sight.over_background
        background = checked_background(self._weights, background, len(self._weights))
        self._has_gradient = False
        loss, shown = self._session.forward_loss(
            images_rgba.contiguous(), background.detach().contiguous(), **seen
        )
        self._has_gradient = True
        if sight is not None:
            sight.shown = shown
        return self._weights.new_tensor(loss)

    def backward_adam(
        self, parameters: Mapping[str, AdamParameter] | None, *, with_vertices: bool = False
    ) -> MorphedGradient:
        """Take one step of Adam, or none, by the gradient of the last forward_loss."""
        if not self._has_gradient:
            raise ValueError("There is no gradient yet. Call forward_loss() first.")
        names = UPDATED_ATTRIBUTES + (BASIS_ATTRIBUTES if self._weights.shape[1] else ())
        groups = [] if parameters is None else [_arrays(parameters[name]) for name in names]
        self._has_gradient = False  # the parameters are others now
        weights = torch.empty_like(self._weights)
        vertices = torch.empty_like(self._vertices) if with_vertices else None
        self._session.backward_adam(groups, weights, vertices)
        if parameters is not None:  # what remembers a tensor asks torch whether it has changed
            increment_version([parameters[name].value for name in names])
        return MorphedGradient(weights, vertices)


def _arrays(parameter: AdamParameter) -> tuple[Tensor, Tensor, Tensor, tuple[float, ...]]:
    """A parameter as compiled code takes it, which would copy what does not fit, in silence."""
    check_moments(parameter)
    return (
        parameter.value.detach(),
        parameter.first_moment.detach(),
        parameter.second_moment.detach(),
        parameter.step_numbers(),
    )
