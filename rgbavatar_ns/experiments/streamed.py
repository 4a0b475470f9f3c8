"""What an online run has kept of its stream: each frame's loss after the end, and its least."""

import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.metrics import l1_over_black
from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.export import draw
from rgbavatar_ns.files import read_json, write_json

_FILE = "streamed.json"
_BATCH = 8


@dataclass(frozen=True)
class StreamedCurve:
    """Streamed frames by number with their L1 after the end.

    The paper's figure of forgetting (supplement, "Impact of global sampling"): what a frame's loss
    is above its least one has been forgotten.
    """

    after: dict[int, float]
    least: dict[int, float]
    """Of frames that were watched during training; the least of all times, the end included."""

    @property
    def forgotten(self) -> float | None:
        """How far the watched frames' losses are above their least, on average; None: none were."""
        if not self.least:
            return None
        return statistics.fmean(self.after[frame] - loss for frame, loss in self.least.items())


@torch.no_grad()
def streamed_losses(avatar: AvatarMethod, dataset: TrackedDataset) -> list[float]:
    """The mean absolute difference over black of each training frame, in the stream's order."""
    losses: list[float] = []
    frames = list(dataset.train)
    for first in range(0, len(frames), _BATCH):
        chosen = frames[first : first + _BATCH]
        drawn = draw(avatar, dataset.theta[chosen], dataset.cameras.select(chosen)).image
        rgba = torch.stack([torch.from_numpy(dataset.read_image(frame)) for frame in chosen])
        losses += l1_over_black(drawn, rgba).tolist()
    return losses


def write_streamed(
    avatar: AvatarMethod, dataset: TrackedDataset, folder: Path, watched: Mapping[int, float]
) -> dict[str, float]:
    """Leave the curve in `folder`/streamed.json; returns `l1_streamed` and `l1_forgotten`.

    watched: the least losses in training by frame number; without any nothing is said of
    forgetting.
    """
    numbers = [dataset.frame_index[frame] for frame in dataset.train]
    after = dict(zip(numbers, streamed_losses(avatar, dataset)))
    least = {n: min(loss, after[n]) for n, loss in sorted(watched.items()) if n in after}
    curve = StreamedCurve(after, least)
    columns = {"frame_index": numbers, "l1": list(after.values())}
    watched_columns = {"watched_index": list(least), "least_l1": list(least.values())}
    write_json(folder / _FILE, columns | watched_columns)
    figures = {"l1_streamed": statistics.fmean(after.values())}
    forgotten = curve.forgotten
    return figures if forgotten is None else {**figures, "l1_forgotten": forgotten}


def read_streamed(folder: Path) -> StreamedCurve | None:
    """What `write_streamed` left; None where it did not."""
    found = read_json(folder / _FILE)
    if found is None:
        return None
    least = dict(zip(found.get("watched_index", ()), found.get("least_l1", ())))
    return StreamedCurve(dict(zip(found["frame_index"], found["l1"])), least)
