"""Batch rasterizer of Gaussians: one specification, several backends, one entrance."""

from rgbavatar_ns.kernels.functional import (
    available_backends,
    rasterize,
    weighted_color_average,
)
from rgbavatar_ns.kernels.types import GaussianSet, PinholeCameras, RenderedBatch, WeightedColors

__all__ = [
    "GaussianSet",
    "PinholeCameras",
    "RenderedBatch",
    "WeightedColors",
    "available_backends",
    "rasterize",
    "weighted_color_average",
]
