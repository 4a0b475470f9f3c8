"""What an avatar saw in training, from its dataset."""

import torch

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.data.native.dataset import TrackedDataset


@torch.no_grad()
def statistics_of(avatar: Avatar, dataset: TrackedDataset) -> TrainingStatistics:
    """Statistics over the dataset's training frames, with the avatar's own weights psi.

    Raises UserError where the dataset's theta does not fit the avatar.
    """
    avatar.require_layout(dataset.layout, f"The dataset {dataset.root}")
    theta = dataset.theta[list(dataset.train)]
    psi = avatar.weights(theta.to(avatar.identity.device)).cpu()
    return TrainingStatistics.of(theta, psi, avatar.layout)
