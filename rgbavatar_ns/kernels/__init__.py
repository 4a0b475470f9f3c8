"""Batch rasterizer of Gaussians: one specification, several backends, one entrance."""

from rgbavatar_ns.kernels.blended import blended_renderer
from rgbavatar_ns.kernels.functional import (
    available_backends,
    rasterize,
    weighted_color_average,
)
from rgbavatar_ns.kernels.registry import BlendedRenderer, DeviceRenderer, unavailable_backends
from rgbavatar_ns.kernels.types import (
    UPDATED_ATTRIBUTES,
    AdamParameter,
    BlendedGaussians,
    BlendedGradient,
    DeviceError,
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
    "DeviceError",
    "DeviceRenderer",
    "GaussianSet",
    "PinholeCameras",
    "RenderedBatch",
    "WeightedColors",
    "available_backends",
    "blended_renderer",
    "rasterize",
    "unavailable_backends",
    "weighted_color_average",
]
