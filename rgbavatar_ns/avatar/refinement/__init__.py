"""Corrections of tracked theta, learnt together with the avatar."""

from rgbavatar_ns.avatar.refinement.corrections import RefinementConfig, TrackingRefinement
from rgbavatar_ns.avatar.refinement.frames import FrameRefinement

__all__ = ["FrameRefinement", "RefinementConfig", "TrackingRefinement"]
