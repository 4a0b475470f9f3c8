"""How an avatar learns: `TrainingStep`, the loop `fit`, losses and first colours."""

from rgbavatar_ns.avatar.training.batches import TrainingBatch
from rgbavatar_ns.avatar.training.loop import FitHooks, LossCurve, fit
from rgbavatar_ns.avatar.training.step import TrainingOptions, TrainingStep, make_optimizer

__all__ = [
    "FitHooks",
    "LossCurve",
    "TrainingBatch",
    "TrainingOptions",
    "TrainingStep",
    "fit",
    "make_optimizer",
]
