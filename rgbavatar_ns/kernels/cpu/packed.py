"""The compiled loops for morphed Gaussians that were packed once for many pictures."""

import os

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.cpu import (
    INSTRUCTION_SET_VARIABLE,
    _native,  # pyright: ignore[reportMissingModuleSource]
)
from rgbavatar_ns.kernels.cpu.morphed import native_cameras, native_gaussians
from rgbavatar_ns.kernels.functional import checked_background
from rgbavatar_ns.kernels.types import MorphedGaussians, PinholeCameras, RenderedBatch


class CpuPackedGaussians:
    """See `kernels.registry.PackedGaussians`."""

    def __init__(self, gaussians: MorphedGaussians) -> None:
        bases, new = gaussians.basis_position, gaussians.position.new_empty
        weights, vertices = new(1, 0 if bases is None else len(bases)), new(1, 0, 3)
        self._packed = _native.Packed(
            native_gaussians(gaussians), weights, vertices, torch.get_num_threads()
        )

    @property
    def count(self) -> int:
        """How many Gaussians a picture can show."""
        return self._packed.count

    @property
    def num_bytes(self) -> int:
        """The memory that the copy takes."""
        return self._packed.bytes

    def renderer(
        self,
        weights: Float[Tensor, "1 K"],
        vertices: Float[Tensor, "1 V 3"],
        cameras: PinholeCameras,
    ) -> "CpuPackedRenderer":
        """Prepare one picture."""
        return CpuPackedRenderer(self._packed, weights, vertices, cameras)


class CpuPackedRenderer:
    """See `kernels.registry.PictureRenderer`."""

    def __init__(
        self,
        packed: "_native.Packed",
        weights: Float[Tensor, "1 K"],
        vertices: Float[Tensor, "1 V 3"],
        cameras: PinholeCameras,
    ) -> None:
        self._size = (1, cameras.height, cameras.width)
        self._like = weights
        self._session = _native.PackedSession(
            packed,
            weights.detach().contiguous(),
            vertices.detach().contiguous(),
            *native_cameras(cameras),
            torch.get_num_threads(),
            os.environ.get(INSTRUCTION_SET_VARIABLE, ""),
        )

    def draw(
        self,
        background: Float[Tensor, "3"] | Float[Tensor, "1 3"] | None = None,
        *,
        with_depth: bool = False,
    ) -> RenderedBatch:
        """As `rasterize`, without gradients."""
        background = checked_background(self._like, background, 1)
        new = self._like.new_empty
        image, alpha = new(*self._size, 3), new(*self._size, 1)
        depth = new(*self._size, 1) if with_depth else None
        self._session.draw(background.detach().contiguous(), 0, image, alpha, depth)
        return RenderedBatch(image, alpha, depth)
