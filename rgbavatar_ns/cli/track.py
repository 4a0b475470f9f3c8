"""`rgbavatar track`: a video of a head becomes a dataset."""

from pathlib import Path
from typing import Annotated

import tyro

from rgbavatar_ns.cli.progress import progress_bar
from rgbavatar_ns.tracking import TrackConfig, track_video


def run(
    videos: Annotated[tuple[Path, ...], tyro.conf.Positional],
    dst: Annotated[Path, tyro.conf.Positional],
    config: Annotated[TrackConfig, tyro.conf.arg(name="")] = TrackConfig(),
) -> None:
    """Find the face, cut out the person, fit the head model and write a dataset.

    Args:
        videos: one file, a folder of images, or several clips of one person.
        dst: the dataset's folder.
        config: options of the tracker.
    """
    with progress_bar("track") as update:
        dataset = track_video(videos, dst, config, progress=update)
    print(f"{len(dataset.train)} frames to train on, {len(dataset.test)} held out, in {dst}")
    print(f"Look at {dst / 'overlay.png'}: the mesh should lie on the face.")
    print(f"Then: ns-train rgbavatar-tiny --data {dst}")
