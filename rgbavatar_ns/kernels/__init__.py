"""Batch rasterizer of Gaussians: one specification, several backends, one entrance."""

from rgbavatar_ns.kernels.blended import blended_renderer
from rgbavatar_ns.kernels.functional import (
    available_backends,
    rasterize,
    weighted_color_average,
)
from rgbavatar_ns.kernels.registry import BlendedRenderer, DeviceRenderer
from rgbavatar_ns.kernels.types import (
    UPDATED_ATTRIBUTES,
    AdamParameter,
    BlendedGaussians,
    BlendedGradient,
    GaussianSet,
    PinholeCameras,
    RenderedBatch,
    WeightedColors,
)

__all__ = [
    "UPDATED_ATTRIBUTES",
    "AdamParameter",
    "BlendedGaussians",
    "BlendedGradient",
    "BlendedRenderer",
    "DeviceRenderer",
    "GaussianSet",
    "PinholeCameras",
    "RenderedBatch",
    "WeightedColors",
    "available_backends",
    "blended_renderer",
    "rasterize",
    "weighted_color_average",
]
