"""The reference as a backend: for float64, and wherever nothing faster runs."""

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.reference import (
    rasterize_reference,
    weighted_color_average_reference,
)
from rgbavatar_ns.kernels.registry import Backend
from rgbavatar_ns.kernels.types import (
    GaussianSet,
    PinholeCameras,
    RenderedBatch,
    WeightedColors,
)


class ReferenceBackend(Backend):
    """Runs everywhere torch does; nothing else here is to be fast."""

    def unsupported_reason(self, device: torch.device, dtype: torch.dtype) -> str | None:
        """None: every device and floating type is taken."""
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
        return rasterize_reference(
            gaussians,
            cameras,
            background,
            with_depth=with_depth,
            with_visibility=with_visibility,
            screen_offset=screen_offset,
        )

    def weighted_color_average(
        self, gaussians: GaussianSet, cameras: PinholeCameras, images: Float[Tensor, "#B H W C"]
    ) -> WeightedColors:
        """As `functional.weighted_color_average`."""
        return weighted_color_average_reference(gaussians, cameras, images)


def load() -> ReferenceBackend:
    """The backend."""
    return ReferenceBackend()
