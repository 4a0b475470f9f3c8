"""Refined tracking under nerfstudio: whether a run can have it, and the file that it leaves."""

from collections.abc import Mapping
from typing import Any

from torch import nn

from rgbavatar_ns.avatar.refinement.corrections import RefinementConfig
from rgbavatar_ns.avatar.refinement.frames import FrameRefinement
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.dataparser import FilmedSubject

REFINED_NAME = "theta_refined.npy"
_PREFIX = "refinement."


def frame_refinement(subject: FilmedSubject, config: RefinementConfig) -> FrameRefinement:
    """The refinement of a dataset's training frames.

    Raises:
        UserError: the frames are those of a stream, which are not known beforehand; or the bases
            are never to learn.
    """
    if max(subject.train, default=-1) >= len(subject.theta):
        raise UserError(
            "Tracking cannot be refined while frames arrive: each is seen too seldom.",
            "Leave out --pipeline.model.refine-tracking, or train on the recorded frames.",
        )
    if not 0 <= config.bases_start < 1:
        raise UserError(
            f"--pipeline.model.refinement.bases-start is {config.bases_start}, but it is the "
            "share of training before the bases learn, at least 0 and below 1.",
            "Pass such a number, or leave it out.",
        )
    return FrameRefinement(subject.theta, subject.train, subject.layout, config)


def require_same_refinement(state_dict: Mapping[str, Any], refinement: nn.Module | None) -> None:
    """Raise UserError where a checkpoint has corrections and the model has none, or reversed."""
    saved = any(name.startswith(_PREFIX) for name in state_dict)
    if saved != (refinement is not None):
        raise UserError(
            f"The checkpoint was trained {'with' if saved else 'without'} refined tracking.",
            f"Pass --pipeline.model.refine-tracking {saved}.",
        )
