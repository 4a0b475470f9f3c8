"""What goes into and comes out of the rasterizer; every backend shares these types.

Conventions: cameras are OpenCV (x right, y down, z forward), lengths are metres, image
coordinates are pixels with the centre of the first pixel at (0.5, 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class GaussianSet:
    """B sets of N world-space Gaussians; a leading 1 stands for all B sets.

    `quats_wxyz` need not be normalised; `scales` are standard deviations in metres;
    `opacities` lie in [0, 1]; `colors` are linear blending colours, usually in [0, 1].
    """

    means: Float[Tensor, "#B N 3"]
    quats_wxyz: Float[Tensor, "#B N 4"]
    scales: Float[Tensor, "#B N 3"]
    opacities: Float[Tensor, "#B N"]
    colors: Float[Tensor, "#B N 3"]


@dataclass(frozen=True)
class PinholeCameras:
    """C cameras of one image size: C is 1 (shared by the batch) or B."""

    world_to_camera: Float[Tensor, "C 4 4"]
    focal_px: Float[Tensor, "C 2"]
    principal_point_px: Float[Tensor, "C 2"]
    width: int
    height: int

    def select(self, positions: Sequence[int]) -> "PinholeCameras":
        """The cameras at these positions, in this order."""
        chosen = list(positions)
        return PinholeCameras(
            self.world_to_camera[chosen],
            self.focal_px[chosen],
            self.principal_point_px[chosen],
            self.width,
            self.height,
        )


@dataclass(frozen=True)
class RenderedBatch:
    """B images; `depth` and `visibility` are there only when they were asked for.

    `depth` is the expected depth in metres along the camera's z (0 where nothing is seen);
    `visibility` is each Gaussian's largest blending weight (alpha times transmittance) over
    the pixels of its image. Both carry no gradient.
    """

    image: Float[Tensor, "B H W 3"]
    alpha: Float[Tensor, "B H W 1"]
    depth: Float[Tensor, "B H W 1"] | None = None
    visibility: Float[Tensor, "B N"] | None = None


@dataclass(frozen=True)
class WeightedColors:
    """Per-Gaussian sums over the pixels of each image, weighted by the blending weight w.

    `weighted_sum` = sum w I, `weight_sum` = sum w, `max_weight` = max w.
    """

    weighted_sum: Float[Tensor, "B N C"]
    weight_sum: Float[Tensor, "B N"]
    max_weight: Float[Tensor, "B N"]
