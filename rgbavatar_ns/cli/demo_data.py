"""`rgbavatar demo-data`: the procedural demo subject as a dataset."""

from pathlib import Path
from typing import Annotated

import tyro

from rgbavatar_ns.cli.progress import progress_bar
from rgbavatar_ns.data.demo import DemoConfig, make_demo_dataset


def run(
    dst: Annotated[Path, tyro.conf.Positional],
    config: Annotated[DemoConfig, tyro.conf.arg(name="")] = DemoConfig(),
) -> None:
    """Render a procedural person, by ray casting, into a dataset with known truth.

    Args:
        dst: the dataset's folder; it must be empty or not exist.
        config: size, length and difficulty.
    """
    with progress_bar("demo subject") as update:
        dataset = make_demo_dataset(dst, config, progress=update)
    print(f"{len(dataset.train)} frames to train on, {len(dataset.test)} held out, in {dst}")
    print(f"Then: ns-train rgbavatar-tiny --data {dst}")
