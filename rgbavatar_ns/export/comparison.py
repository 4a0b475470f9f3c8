"""The avatar beside the frames that it was not trained on: a film and a picture."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.drawing.compositing import error_strip, to_uint8
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.drawing import draw
from rgbavatar_ns.export.video import write_png, write_video


def comparison_frames(
    avatar: AvatarMethod,
    dataset: TrackedDataset,
    positions: Sequence[int],
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Iterator[np.ndarray]:
    """Yield truth, avatar and error for each position, uint8 [3, H, W, 3] on one background.

    The error picture is the absolute difference times 4, so that 1/4 is white.
    """
    device = avatar.identity.device
    ground = torch.tensor(background, device=device)
    for position in positions:
        rgba = torch.from_numpy(dataset.read_image(position)).to(device)
        theta = dataset.theta[position : position + 1]
        image = draw(avatar, theta, dataset.cameras.select([position]), background).image[0]
        yield to_uint8(error_strip(rgba, image, ground))


def write_comparison(
    avatar: AvatarMethod,
    dataset: TrackedDataset,
    video: Path,
    picture: Path,
    positions: Sequence[int] | None = None,
    columns: int = 5,
    frames_per_second: float | None = None,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Write the film (truth, avatar, error side by side) and a picture of a few frames.

    positions: the held-out frames by default, of one camera after the other. frames_per_second:
    by default the film's own. The picture has one column for each of `columns`
    evenly spread frames: truth above, avatar in the middle, error (times 4) below. Returns the
    number of frames. Raises UserError where no frames are held out.
    """
    names = dataset.camera_names
    held_out = sorted(dataset.test, key=lambda position: names[position]) if names else dataset.test
    chosen = tuple(held_out if positions is None else positions)
    if not chosen:
        raise UserError(
            f"The dataset {dataset.root} holds out no frames.",
            "Name the frames to compare (--frames 0 20).",
        )
    shown = {chosen[i] for i in np.linspace(0, len(chosen) - 1, columns).round().astype(int)}
    kept: list[np.ndarray] = []

    def film() -> Iterator[np.ndarray]:
        compared = comparison_frames(avatar, dataset, chosen, background)
        for done, (position, row) in enumerate(zip(chosen, compared), start=1):
            if position in shown:
                kept.append(np.vstack([*row]))
            yield np.hstack([*row])
            if progress is not None:
                progress(done, len(chosen))

    count = write_video(video, film(), frames_per_second or dataset.playback_rate)
    write_png(picture, np.concatenate(kept, axis=1))
    return count
