"""Which Gaussians a film could show at all; beyond its pictures' edges they are left to chance."""

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.head import is_same_identity

_MOST_FRAMES = 24
"""Spread over the film: people sit as still as that."""
_AT_ONCE = 8


@torch.no_grad()
def within_film(avatar: AvatarMethod, dataset: TrackedDataset) -> Bool[Tensor, "N"]:
    """Which Gaussians have their centre within some picture of the film, seen or behind others.

    A body that the film cuts off goes on beyond the cut in the head model. Its Gaussians there
    trained on no more than what of them reaches in: nothing else is known of them. Ours, because a
    page that is taller than the film showed them.
    """
    last = len(dataset) - 1
    frames = np.unique(np.linspace(0, last, min(len(dataset), _MOST_FRAMES)).round().astype(int))
    kept = torch.zeros(avatar.num_gaussians, dtype=torch.bool)
    for places in np.array_split(frames, -(-len(frames) // _AT_ONCE)):
        theta = dataset.theta[places.tolist()].to(avatar.identity)
        cameras = dataset.cameras.select(places.tolist())
        kept |= cameras.shows(avatar.gaussians(theta).means.cpu()).any(0)
    return kept


def is_of(avatar: AvatarMethod, dataset: TrackedDataset) -> bool:
    """Whether a dataset is of the avatar's person; another's drives, but shows nothing of it."""
    return is_same_identity(avatar.identity, dataset.identity)


def as_filmed(avatar: Avatar, dataset: TrackedDataset) -> Avatar:
    """The avatar without what lies beyond the film's edges (`within_film`)."""
    kept = torch.nonzero(within_film(avatar, dataset))[:, 0]
    if len(kept) in (0, avatar.num_gaussians):
        return avatar  # without any, the data's cameras are not of this avatar
    return avatar.with_gaussians(kept)
