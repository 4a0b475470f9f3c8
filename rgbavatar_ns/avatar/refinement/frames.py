"""Corrections to the training frames of a dataset, found by a frame's place in it."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.refinement.corrections import RefinementConfig, TrackingRefinement
from rgbavatar_ns.head import ThetaLayout


class FrameRefinement(nn.Module):
    """Corrects training frames; from others it takes what all training frames had wrong.

    `theta` is that of all F frames, as tracked; `train` are the positions of the training frames.
    """

    _row_of: Tensor

    def __init__(
        self,
        theta: Float[Tensor, "F H"],
        train: Sequence[int],
        layout: ThetaLayout,
        config: RefinementConfig | None = None,
    ) -> None:
        super().__init__()
        config = RefinementConfig() if config is None else config
        rows = torch.tensor(train, dtype=torch.int64)
        row_of = torch.full((len(theta),), -1, dtype=torch.int64)
        row_of[rows] = torch.arange(len(rows))
        self.register_buffer("_row_of", row_of, persistent=False)
        self.start_step = config.start_step
        self.frames = TrackingRefinement(theta[rows], layout, config)

    def corrected(
        self, theta: Float[Tensor, "B H"], position: Int[Tensor, "B"]
    ) -> Float[Tensor, "B H"]:
        """The corrected theta of training frames; of others, what the tracker said, calibrated."""
        rows = self._row_of[position]
        known = rows >= 0
        if bool(known.all()):
            return self.frames.theta(rows)
        corrected = self.frames.theta(rows.clamp(min=0))
        return torch.where(known[:, None], corrected, self.frames.calibrated(theta))

    def begin(
        self, theta: Float[Tensor, "B H"], position: Int[Tensor, "B"] | None
    ) -> Float[Tensor, "B H"]:
        """The corrected theta of a batch, where its training step is to leave a gradient."""
        if position is None:
            raise ValueError("Refined tracking needs the frames' positions.")
        return self.corrected(theta, position).requires_grad_()

    def learn(
        self, step: int, theta: Float[Tensor, "B H"], position: Int[Tensor, "P"] | None
    ) -> None:
        """Correct a batch's first P frames, once it is time, by the gradient that is in `theta`."""
        if step >= self.start_step and theta.grad is not None and position is not None:
            # The batch's loss is a mean; each frame is to have the gradient of its own.
            own = theta.grad[: len(position)] * len(theta)
            self.frames.step(self._row_of[position], own)

    def all_frames(self, tracked: Float[Tensor, "F H"]) -> Float[Tensor, "F H"]:
        """The whole dataset's theta, corrected or calibrated."""
        return self.corrected(tracked, torch.arange(len(tracked), device=tracked.device))
