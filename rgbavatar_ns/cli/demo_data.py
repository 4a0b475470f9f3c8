"""`rgbavatar demo-data`: the procedural demo subject as a dataset."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from rgbavatar_ns.cli.console import command_line
from rgbavatar_ns.cli.progress import progress_bar
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset
from rgbavatar_ns.synthetic.exporters import write_demo

DataFormat = Literal["native", "insta", "metrical", "vhap", "flashavatar", "imavatar"]


def run(
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")],
    config: Annotated[DemoConfig, tyro.conf.arg(name="")] = DemoConfig(),
    format: DataFormat = "native",
    overwrite: bool = False,
) -> None:
    """Render a procedural person, by ray casting, into a dataset with known truth.

    Args:
        dst: the dataset's folder; it must be empty or not exist.
        config: size, length and difficulty.
        format: as which system the data is written; all but native come with a FLAME-shaped model
            that holds nothing of FLAME.
        overwrite: replace a dataset of the native format in DST; other files there stay.
    """
    train = command_line("ns-train", "rgbavatar-tiny", "--data", dst)
    if format == "native":
        with progress_bar("demo subject") as update:
            dataset = make_demo_dataset(dst, config, progress=update, overwrite=overwrite)
        print(f"{len(dataset.train)} frames to train on, {len(dataset.test)} held out, in {dst}")
        print(f"Then: {train}")
        return
    if overwrite:
        raise UserError(f"{format} data is not overwritten.", "Name a new folder.")
    with progress_bar("demo subject") as update:
        flame = write_demo(dst, format, config, progress=update)
    print(f"{config.num_frames} frames as {format} data, in {dst}")
    print(f"Then: RGBAVATAR_FLAME={command_line(flame)} {train}")
