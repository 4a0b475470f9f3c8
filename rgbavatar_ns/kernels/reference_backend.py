"""The reference as a backend: for float64, and wherever nothing faster runs."""

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.posing import PosingParameters
from rgbavatar_ns.kernels.reference import (
    rasterize_reference,
    weighted_color_average_reference,
)
from rgbavatar_ns.kernels.types import (
    GaussianSet,
    MorphedGaussians,
    PinholeCameras,
    RenderedBatch,
    WeightedColors,
)


class ReferenceBackend:
    """Runs everywhere torch does."""

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

    def morphed_renderer(
        self,
        gaussians: MorphedGaussians,
        weights: Float[Tensor, "B K"],
        vertices: Float[Tensor, "B V 3"],
        cameras: PinholeCameras,
    ) -> None:
        """None: morphing in torch and `rasterize` are the specification."""
        return None

    def packed_gaussians(self, gaussians: MorphedGaussians) -> None:
        """None: nothing here is to be fast."""
        return None

    def posing(self, parameters: PosingParameters) -> None:
        """None: nothing here is to be fast."""
        return None

    def mean_similarity(
        self,
        image: Float[Tensor, "B H W 3"],
        target: Float[Tensor, "B H W 3"],
        window: Float[Tensor, "11"],
        stabilizers: tuple[float, float],
        *,
        with_gradient: bool,
    ) -> None:
        """None: nothing here is to be fast."""
        return None

    def harmonic_colors(
        self, coefficients: Float[Tensor, "#B N C 3"], directions: Float[Tensor, "B N 3"]
    ) -> None:
        """None: nothing here is to be fast."""
        return None


def load() -> ReferenceBackend:
    """The backend."""
    return ReferenceBackend()
