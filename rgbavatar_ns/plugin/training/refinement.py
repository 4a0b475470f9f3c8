"""Refinement of tracked theta under nerfstudio: by frame while training, and of held-out frames."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from rgbavatar_ns.avatar.refinement.corrections import RefinementConfig, TrackingRefinement
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.dataparser import Subject

REFINED_NAME = "theta_refined.npy"
_PREFIX = "refinement."


class FrameRefinement(nn.Module):
    """Corrections to the training frames of a dataset, found by position in it.

    Raises:
        UserError: the frames are those of a stream, which are not known beforehand; or the bases
            are never to learn.
    """

    _row_of: Tensor

    def __init__(self, subject: Subject, config: RefinementConfig) -> None:
        super().__init__()
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
        train = torch.tensor(subject.train, dtype=torch.int64)
        row_of = torch.full((len(subject.theta),), -1, dtype=torch.int64)
        row_of[train] = torch.arange(len(train))
        self.register_buffer("_row_of", row_of, persistent=False)
        self.start_step = config.start_step
        self.frames = TrackingRefinement(subject.theta[train], subject.layout, config)

    def corrected(
        self, theta: Float[Tensor, "B H"], position: Float[Tensor, "B 1"]
    ) -> Float[Tensor, "B H"]:
        """The corrected theta of training frames; of others, what the tracker said, calibrated."""
        rows = self._row_of[position[:, 0].long()]
        known = rows >= 0
        if bool(known.all()):
            return self.frames.theta(rows)
        corrected = self.frames.theta(rows.clamp(min=0))
        return torch.where(known[:, None], corrected, self.frames.calibrated(theta))

    def step(
        self, step: int, position: Float[Tensor, "B 1"], gradient: Float[Tensor, "B H"]
    ) -> None:
        """Correct a batch of training frames, once it is time, by the gradient of its loss."""
        if step >= self.start_step:
            rows = self._row_of[position[:, 0].long()]
            # The batch's loss is a mean; each frame is to have the gradient of its own.
            self.frames.step(rows, gradient * len(gradient))

    def save(self, path: Path, tracked: Float[Tensor, "F H"]) -> None:
        """Write theta of all frames, corrected or calibrated, as float32 [F, H]."""
        np.save(path, self.all_frames(tracked).cpu().numpy().astype(np.float32))

    def all_frames(self, tracked: Float[Tensor, "F H"]) -> Float[Tensor, "F H"]:
        """The whole dataset's theta, corrected or calibrated."""
        position = torch.arange(len(tracked), device=tracked.device)[:, None].float()
        return self.corrected(tracked, position)


def require_same_refinement(state_dict: Mapping[str, Any], refinement: nn.Module | None) -> None:
    """Raise UserError where a checkpoint has corrections and the model has none, or reversed."""
    saved = any(name.startswith(_PREFIX) for name in state_dict)
    if saved != (refinement is not None):
        raise UserError(
            f"The checkpoint was trained {'with' if saved else 'without'} refined tracking.",
            f"Pass --pipeline.model.refine-tracking {saved}.",
        )
