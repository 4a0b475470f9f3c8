"""What a user of the viewer asks to see, and which theta and psi that means."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.export.bases import basis_weights

DrivenBy = Literal["dataset frame", "viewer's time", "by hand", "driving sequence"]
PictureKind = Literal["avatar", "beside the film", "error", "alpha", "depth"]

_Theta = Float[Tensor, "H"]
_Weights = Float[Tensor, "K"]


@dataclass
class ViewerState:
    """The state of the panel. Values are replaced, never changed in place: other threads read."""

    driven_by: DrivenBy = "dataset frame"
    frame: int = 0
    theta_by_hand: _Theta | None = None
    sequence: Float[Tensor, "S H"] | None = None
    """Another person's performance in the avatar's theta."""
    sequence_frame: int = 0
    psi_by_hand: _Weights | None = None
    """Replaces the weight network's answer."""
    bases_used: int | None = None
    """Only the first so many bases count; all where it is None."""
    basis_alone: int | None = None
    """Show this basis alone, on the neutral frame."""
    gain: float = 1.5
    """By how much a basis that is shown alone is exaggerated."""
    picture: PictureKind = "avatar"
    mesh: bool = False
    centres: bool = False
    backdrop: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the head in [0, 1]."""


@dataclass(frozen=True)
class Shown:
    """What drives one picture; `psi` is None where the weight network decides."""

    theta: Float[Tensor, "1 H"]
    psi: Float[Tensor, "1 K"] | None
    position: int | None
    """The frame of the dataset that it can be compared with, if there is one."""


@dataclass
class Stage:
    """The avatar and the frames that can drive it."""

    avatar: Avatar
    num_frames: int
    theta_of: Callable[[int], Float[Tensor, "1 H"]]
    """Theta of a frame of the dataset, corrected if tracking is refined."""
    training_theta: Callable[[], Float[Tensor, "F H"]]
    film: TrackedDataset | None = field(default=None)
    """Where the frames' pictures are, if there are any."""

    @torch.no_grad()
    def statistics(self) -> TrainingStatistics:
        """What the avatar has seen, with the weights that its network gives now."""
        theta = self.training_theta()
        psi = self.avatar.weights(theta.to(self.avatar.identity))
        return TrainingStatistics.of(theta.cpu(), psi.cpu(), self.avatar.layout)

    @torch.no_grad()
    def shown(self, wishes: ViewerState, time: float | None = None) -> Shown:
        """What drives the picture; `time` in [0, 1] counts where it is asked for."""
        if wishes.basis_alone is not None and wishes.basis_alone < self.avatar.config.num_bases:
            statistics = self.statistics()
            psi = basis_weights(statistics, wishes.gain)[wishes.basis_alone + 1]
            return self._on_device(statistics.theta_neutral, psi, None)
        theta, position = self._theta(wishes, time)
        psi = wishes.psi_by_hand
        used = wishes.bases_used
        if used is not None and used < self.avatar.config.num_bases:
            psi = (
                self.avatar.weights(theta[None].to(self.avatar.identity))[0] if psi is None else psi
            )
            psi = torch.where(torch.arange(len(psi), device=psi.device) < used, psi, 0.0)
        return self._on_device(theta, psi, position)

    def _theta(self, wishes: ViewerState, time: float | None) -> tuple[_Theta, int | None]:
        last = self.num_frames - 1
        if wishes.driven_by == "by hand" and wishes.theta_by_hand is not None:
            return wishes.theta_by_hand, min(wishes.frame, last)
        if wishes.driven_by == "driving sequence" and wishes.sequence is not None:
            place = min(max(wishes.sequence_frame, 0), len(wishes.sequence) - 1)
            return wishes.sequence[place], None
        position = wishes.frame
        if wishes.driven_by == "viewer's time" and time is not None:
            position = round(time * last)
        position = min(max(position, 0), last)
        return self.theta_of(position)[0], position

    def _on_device(self, theta: _Theta, psi: _Weights | None, position: int | None) -> Shown:
        like = self.avatar.identity
        return Shown(theta[None].to(like), None if psi is None else psi[None].to(like), position)


def random_expression(
    statistics: TrainingStatistics, theta: _Theta, generator: torch.Generator | None = None
) -> _Theta:
    """A random expression within what was seen in training, on the pose of `theta`."""
    low, high = statistics.component_min, statistics.component_max
    along = low + (high - low) * torch.rand(len(low), generator=generator)
    drawn = statistics.theta_mean + along @ statistics.components
    return torch.where(statistics.expressive, drawn.to(theta), theta)
