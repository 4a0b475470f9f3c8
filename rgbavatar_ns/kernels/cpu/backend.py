"""The compiled rasterizer behind torch's autograd.

The environment variable RGBAVATAR_INSTRUCTION_SET (generic, avx2, avx512) forces one copy of the
loops; without it the fastest that the processor runs is taken.
"""

import os
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.cpu import (
    INSTRUCTION_SET_VARIABLE,
    _native,  # pyright: ignore[reportMissingModuleSource]
)
from rgbavatar_ns.kernels.cpu.harmonics import compiled_harmonic_colors
from rgbavatar_ns.kernels.cpu.morphed import CpuMorphedRenderer
from rgbavatar_ns.kernels.cpu.packed import CpuPackedGaussians
from rgbavatar_ns.kernels.cpu.posing import CpuPosing
from rgbavatar_ns.kernels.differentiable import (
    Drawn,
    Gradients,
    draw_differentiably,
    gaussian_inputs,
)
from rgbavatar_ns.kernels.posing import PosingParameters
from rgbavatar_ns.kernels.registry import Backend
from rgbavatar_ns.kernels.types import (
    GaussianSet,
    MorphedGaussians,
    PinholeCameras,
    RenderedBatch,
    WeightedColors,
)


def instruction_sets() -> tuple[str, ...]:
    """Instruction sets whose loops this processor runs, the fastest first."""
    return tuple(_native.instruction_sets())


def compiled_constants() -> dict[str, float | tuple[int, ...]]:
    """The numbers of `kernels/constants.py` as the compiled loops have them."""
    return _native.constants()


@dataclass
class _Request:
    """What of a rendering is not differentiated, and the outputs that carry no gradient."""

    cameras: PinholeCameras
    batch: int
    depth: Tensor | None
    visibility: Tensor | None


def _session(gaussians: tuple[Tensor, ...], cameras: PinholeCameras, batch: int):
    return _native.Session(
        _native.Gaussians(*gaussians),
        cameras.world_to_camera.detach().contiguous(),
        cameras.focal_px.detach().contiguous(),
        cameras.principal_point_px.detach().contiguous(),
        batch,
        cameras.width,
        cameras.height,
        torch.get_num_threads(),
        os.environ.get(INSTRUCTION_SET_VARIABLE, ""),
    )


def _draw(
    request: _Request, gaussians: tuple[Tensor, ...], background: Tensor
) -> tuple[Tensor, Tensor, Gradients]:
    """See `kernels.differentiable.Draw`."""
    size = (request.batch, request.cameras.height, request.cameras.width)
    image, alpha = background.new_empty(*size, 3), background.new_empty(*size, 1)
    session = _session(gaussians, request.cameras, request.batch)
    session.draw(background, 0, image, alpha, request.depth)
    if request.visibility is not None:
        session.average(None, None, None, request.visibility)

    def gradients(
        gaussians: tuple[Tensor, ...],
        drawn: Drawn,
        image_grad: Tensor | None,
        alpha_grad: Tensor | None,
    ) -> list[Tensor]:
        filled = [torch.empty_like(t) for t in gaussians]
        session.backward(
            _native.Gaussians(*gaussians),
            drawn.background,
            image_grad,
            alpha_grad,
            torch.get_num_threads(),
            *filled,
        )
        return filled

    return image, alpha, gradients


class CpuBackend(Backend):
    """Runs float32 tensors in main memory, on as many threads as torch uses."""

    def unsupported_reason(self, device: torch.device, dtype: torch.dtype) -> str | None:
        """The reason, unless it is float32 on a CPU."""
        if device.type != "cpu" or dtype != torch.float32:
            return "it takes float32 tensors on the CPU"
        return None

    def rasterize(
        self,
        gaussians: GaussianSet,
        cameras: PinholeCameras,
        background: Float[Tensor, "#B 3"],
        *,
        with_depth: bool,
        with_visibility: bool,
        screen_offset: Float[Tensor, "B N 2"] | None,
    ) -> RenderedBatch:
        """As `functional.rasterize`."""
        inputs = gaussian_inputs(gaussians, screen_offset)
        batch = max(t.shape[0] for t in (*inputs, background, cameras.focal_px))
        new = inputs[0].new_empty
        size = (batch, cameras.height, cameras.width, 1)
        request = _Request(
            cameras,
            batch,
            new(size) if with_depth else None,
            new(batch, inputs[0].shape[1]) if with_visibility else None,
        )
        image, alpha = draw_differentiably(partial(_draw, request), *inputs, background)
        return RenderedBatch(image, alpha, request.depth, request.visibility)

    @torch.no_grad()
    def weighted_color_average(
        self, gaussians: GaussianSet, cameras: PinholeCameras, images: Float[Tensor, "#B H W C"]
    ) -> WeightedColors:
        """As `functional.weighted_color_average`."""
        inputs = tuple(tensor.detach().contiguous() for tensor in gaussian_inputs(gaussians))
        batch = max(t.shape[0] for t in (*inputs, images, cameras.focal_px))
        count = inputs[0].shape[1]
        weighted_sum = images.new_empty(batch, count, images.shape[-1])
        weight_sum, max_weight = images.new_empty(2, batch, count).unbind(0)
        session = _session(inputs, cameras, batch)
        session.average(images.detach().contiguous(), weighted_sum, weight_sum, max_weight)
        return WeightedColors(weighted_sum, weight_sum, max_weight)

    def morphed_renderer(
        self,
        gaussians: MorphedGaussians,
        weights: Float[Tensor, "B K"],
        vertices: Float[Tensor, "B V 3"],
        cameras: PinholeCameras,
    ) -> CpuMorphedRenderer:
        """As `morphed.morphed_renderer`."""
        return CpuMorphedRenderer(gaussians, weights, vertices, cameras)

    def packed_gaussians(self, gaussians: MorphedGaussians) -> CpuPackedGaussians:
        """As `morphed.packed_gaussians`."""
        return CpuPackedGaussians(gaussians)

    def posing(self, parameters: PosingParameters) -> CpuPosing:
        """As `morphed.posing_of`."""
        return CpuPosing(parameters)

    def mean_similarity(
        self,
        image: Float[Tensor, "B H W 3"],
        target: Float[Tensor, "B H W 3"],
        window: Float[Tensor, "11"],
        stabilizers: tuple[float, float],
        *,
        with_gradient: bool,
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B H W 3"] | None]:
        """As `similarity.mean_similarity`."""
        image, target = image.detach().contiguous(), target.detach().contiguous()
        gradient = torch.empty_like(image) if with_gradient else None
        c1, c2 = stabilizers
        means = _native.mean_similarity(
            image,
            target,
            window.detach().contiguous(),
            c1,
            c2,
            gradient,
            torch.get_num_threads(),
            os.environ.get(INSTRUCTION_SET_VARIABLE, ""),
        )
        return image.new_tensor(means), gradient

    def harmonic_colors(
        self, coefficients: Float[Tensor, "#B N C 3"], directions: Float[Tensor, "B N 3"]
    ) -> Float[Tensor, "B N 3"]:
        """As `harmonics.harmonic_colors`."""
        return compiled_harmonic_colors(coefficients, directions)


def load() -> CpuBackend:
    """The backend; raises ImportError with the reason when it was not compiled."""
    return CpuBackend()
