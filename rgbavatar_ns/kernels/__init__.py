"""Batch rasterizer of Gaussians: one specification, several backends, one entrance."""

from rgbavatar_ns.kernels.functional import (
    available_backends,
    rasterize,
    weighted_color_average,
)
from rgbavatar_ns.kernels.harmonics import harmonic_colors
from rgbavatar_ns.kernels.morphed import (
    morphed_renderer,
    packed_gaussians,
    picture_renderer,
    posing_of,
)
from rgbavatar_ns.kernels.posing import Posing, PosingParameters
from rgbavatar_ns.kernels.registry import (
    DeviceRenderer,
    MorphedRenderer,
    PackedGaussians,
    PictureRenderer,
    unavailable_backends,
)
from rgbavatar_ns.kernels.similarity import mean_similarity
from rgbavatar_ns.kernels.types import (
    BASIS_ATTRIBUTES,
    CAMERA_TENSORS,
    UPDATED_ATTRIBUTES,
    AdamParameter,
    DeviceError,
    FirstSight,
    GaussianSet,
    MorphedGaussians,
    MorphedGradient,
    PinholeCameras,
    RenderedBatch,
    WeightedColors,
)

__all__ = [
    "BASIS_ATTRIBUTES",
    "CAMERA_TENSORS",
    "UPDATED_ATTRIBUTES",
    "AdamParameter",
    "DeviceError",
    "DeviceRenderer",
    "FirstSight",
    "GaussianSet",
    "MorphedGaussians",
    "MorphedGradient",
    "MorphedRenderer",
    "PackedGaussians",
    "PictureRenderer",
    "PinholeCameras",
    "Posing",
    "PosingParameters",
    "RenderedBatch",
    "WeightedColors",
    "available_backends",
    "harmonic_colors",
    "mean_similarity",
    "morphed_renderer",
    "packed_gaussians",
    "picture_renderer",
    "posing_of",
    "rasterize",
    "unavailable_backends",
    "weighted_color_average",
]
