"""What an online run has kept of its stream: the loss of each streamed frame after the end."""

from pathlib import Path

import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.drawing.compositing import film_over
from rgbavatar_ns.export import draw
from rgbavatar_ns.files import read_json, write_json

_FILE = "streamed.json"
_BATCH = 8


@torch.no_grad()
def streamed_losses(avatar: Avatar, dataset: TrackedDataset) -> list[float]:
    """The mean absolute difference over black of each training frame, in the stream's order.

    The paper's curve of forgetting (supplement, "Impact of global sampling"): where it rises
    towards the beginning, the avatar has forgotten.
    """
    losses: list[float] = []
    frames = list(dataset.train)
    for first in range(0, len(frames), _BATCH):
        chosen = frames[first : first + _BATCH]
        drawn = draw(avatar, dataset.theta[chosen], dataset.cameras.select(chosen)).image
        rgba = torch.stack([torch.from_numpy(dataset.read_image(frame)) for frame in chosen])
        shown = drawn.clamp(0, 1)
        truth = film_over(rgba.to(drawn.device), drawn.new_zeros(3), shown)
        losses += (shown - truth).abs().mean(dim=(1, 2, 3)).tolist()
    return losses


def write_streamed(avatar: Avatar, dataset: TrackedDataset, folder: Path) -> float:
    """Leave the curve in `folder`/streamed.json and return its mean."""
    losses = streamed_losses(avatar, dataset)
    numbers = [dataset.frame_index[frame] for frame in dataset.train]
    write_json(folder / _FILE, {"frame_index": numbers, "l1": losses})
    return sum(losses) / len(losses)


def read_streamed(folder: Path) -> tuple[list[int], list[float]] | None:
    """Frame numbers and their losses that `write_streamed` left; None where it did not."""
    curve = read_json(folder / _FILE)
    return None if curve is None else (curve["frame_index"], curve["l1"])
