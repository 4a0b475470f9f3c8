"""Which theta and psi a viewer's state means on a model."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics, neutral_frame
from rgbavatar_ns.export.bases import single_bases
from rgbavatar_ns.plugin.avatar_model import AvatarModel
from rgbavatar_ns.plugin.checkpoint_state import film_statistics
from rgbavatar_ns.plugin.film_path import FilmMoment, frame_at
from rgbavatar_ns.plugin.viewer.viewer_state import ViewerState


@dataclass(frozen=True)
class DrivingSignal:
    """What drives one picture; `psi` is None where the weight network decides."""

    theta: Float[Tensor, "1 H"]
    psi: Float[Tensor, "1 K"] | None = None
    frame: int | None = None
    """The frame of the dataset that it can be compared with, if there is one."""


def training_statistics(model: AvatarModel) -> TrainingStatistics:
    """What the avatar has seen so far, with the weights that its network gives now."""
    film = None if model.filmed is None else model.filmed()
    if film is None or len(film.theta) == 0:
        theta = model.driving_theta(list(range(len(model.frame_theta))))
        film = replace(model.subject, theta=theta.cpu())
    return film_statistics(model.avatar, film)


def neutral_of_shown(model: AvatarModel) -> Float[Tensor, "H"]:
    """The frame with the most neutral expression of those that the viewer can show."""
    theta = model.driving_theta(list(model.subject.train) or [0])
    avatar = model.avatar
    return neutral_frame(theta.cpu(), avatar.layout, avatar.head.arrays.expression_names)


@torch.no_grad()
def driving_signal(
    model: AvatarModel,
    state: ViewerState,
    time: float | FilmMoment | None = None,
    seen: TrainingStatistics | None = None,
) -> DrivingSignal:
    """What drives the picture; `time` (in [0, 1], or a moment) counts where the state asks it.

    seen: what is known of the film, where it is known.
    """
    avatar = model.avatar
    alone, used = state.basis_alone, state.bases_used
    if alone is not None and alone < avatar.num_bases:
        statistics = training_statistics(model) if seen is None else seen
        theta, frame = statistics.theta_neutral, None
        psi = single_bases(statistics, state.gain)[alone + 1]
    else:
        theta, frame = _theta(model, state, time)
        psi = state.psi_by_hand
        if used is not None and used < avatar.num_bases:
            psi = avatar.weights(theta[None].to(avatar.identity))[0] if psi is None else psi
            psi = torch.where(torch.arange(len(psi), device=psi.device) < used, psi, 0.0)
    like = avatar.identity
    return DrivingSignal(theta[None].to(like), None if psi is None else psi[None].to(like), frame)


def _theta(
    model: AvatarModel, state: ViewerState, time: float | FilmMoment | None
) -> tuple[Float[Tensor, "H"], int | None]:
    last = len(model.frame_theta) - 1
    if state.driven_by == "by hand" and state.theta_by_hand is not None:
        return state.theta_by_hand, min(state.frame, last)
    if state.driven_by == "driving sequence" and state.sequence is not None:
        return state.sequence[min(max(state.sequence_frame, 0), len(state.sequence) - 1)], None
    if state.driven_by == "live performer" and state.live is not None:
        return state.live.theta, None
    frame = min(max(state.frame, 0), last)
    if state.driven_by == "viewer's time" and time is not None:
        if isinstance(time, FilmMoment):
            before, after = model.driving_theta([time.before, time.after])
            return model.avatar.layout.between(before, after, time.share), time.nearest
        frame = frame_at(time, last + 1)
    return model.driving_theta([frame])[0], frame


def random_expression(
    statistics: TrainingStatistics, theta: Float[Tensor, "H"]
) -> Float[Tensor, "H"]:
    """A random expression within what was seen in training, on the pose of `theta`."""
    low, high = statistics.component_min, statistics.component_max
    drawn = statistics.theta_mean + (low + (high - low) * torch.rand(len(low))) @ (
        statistics.components
    )
    return torch.where(statistics.expressive, drawn.to(theta), theta)
