"""Reduced Gaussian blendshapes: theta to Gaussians, their training losses and metrics."""

from rgbavatar_ns.avatar.avatar import FILM_RANGE, LEARNING_RATES, Avatar
from rgbavatar_ns.avatar.config import AvatarConfig
from rgbavatar_ns.avatar.model.blendshapes import TangentBlendshapes, TangentGaussians
from rgbavatar_ns.avatar.model.weight_network import WeightNetwork

__all__ = [
    "FILM_RANGE",
    "LEARNING_RATES",
    "Avatar",
    "AvatarConfig",
    "TangentBlendshapes",
    "TangentGaussians",
    "WeightNetwork",
]
