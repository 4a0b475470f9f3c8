"""The least loss that watched frames of a stream ever had (paper, supplement, global sampling)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rgbavatar_ns.files import read_json, write_json

LEAST_NAME = "least.json"


class LeastLosses:
    """By the frames' own numbers; looked at in turn."""

    def __init__(self, known: Mapping[int, float] | None = None) -> None:
        self.by_frame: dict[int, float] = dict(known or {})

    def see(self, frames: Sequence[int], losses: Sequence[float]) -> None:
        """Take in what the frames' losses are now."""
        for frame, loss in zip(frames, losses):
            self.by_frame[frame] = min(loss, self.by_frame.get(frame, loss))

    def write(self, folder: Path) -> None:
        """Leave them in `folder`, if any frame was watched."""
        if self.by_frame:
            frames = sorted(self.by_frame)
            losses = [self.by_frame[frame] for frame in frames]
            write_json(folder / LEAST_NAME, {"frame_index": frames, "l1": losses})


def read_least(folder: Path) -> dict[int, float]:
    """What `LeastLosses.write` left; nothing where no frame was watched."""
    content = read_json(folder / LEAST_NAME)
    return {} if content is None else dict(zip(content["frame_index"], content["l1"]))
