"""`rgbavatar render`: a trained avatar beside the frames it was not trained on."""

from pathlib import Path
from typing import Annotated

import tyro


def run(
    run_folder: Annotated[Path, tyro.conf.Positional],
    output: Annotated[Path, tyro.conf.Positional],
    data: Path,
    frames_per_second: float = 25.0,
) -> None:
    """Write OUTPUT/comparison.mp4 and OUTPUT/comparison.png: truth, avatar, error times 4.

    Args:
        run_folder: a run of ns-train, a checkpoint or an avatar bundle.
        output: the folder to write to.
        data: the dataset whose held-out frames are shown.
        frames_per_second: of the film.
    """
    from rgbavatar_ns import Avatar
    from rgbavatar_ns.data import load_dataset
    from rgbavatar_ns.export import write_comparison

    video, picture = output / "comparison.mp4", output / "comparison.png"
    count = write_comparison(
        Avatar.load(run_folder),
        load_dataset(data),
        video,
        picture,
        frames_per_second=frames_per_second,
    )
    print(f"{count} held-out frames: {video} and {picture}")
