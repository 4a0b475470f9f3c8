"""`rgbavatar import`: another system's data becomes a dataset in the project's own format."""

from pathlib import Path
from typing import Annotated

import tyro

from rgbavatar_ns.cli.console import command_line, plain_console
from rgbavatar_ns.cli.progress import stage_bars
from rgbavatar_ns.data.importers import ImportOptions, import_dataset


def run(
    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")],
    dst: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")],
    options: Annotated[ImportOptions, tyro.conf.arg(name="")] = ImportOptions(),
    overwrite: bool = False,
) -> None:
    """Read data of metrical-tracker, INSTA, GaussianBlendshapes, VHAP and others; write a dataset.

    The folder's content tells the format. An interrupted command goes on where it was when it is
    given again. `ns-train rgbavatar --data SRC` takes SRC too, without this step.

    Args:
        src: the system's folder of one subject (docs/dataset_format.md).
        dst: the dataset's folder; it must be empty or not exist.
        options: how SRC is read.
        overwrite: replace a dataset that is in DST.
    """
    with stage_bars("files") as update:
        dataset = import_dataset(src, dst, options, overwrite=overwrite, progress=update)
    console = plain_console()
    console.print(f"recognised: {dataset.source.get('format')}, head {dataset.arrays.name}")
    for note in dataset.source.get("notes", ()):
        console.print(f"note: {note}")
    cameras = len(set(dataset.camera_names))
    seen_by = f" of {cameras} cameras" if cameras else ""
    console.print(
        f"{len(dataset.train)} frames{seen_by} to train on, {len(dataset.test)} held out, "
        f"{dataset.width} x {dataset.height} pixels, in {dst}"
    )
    look = command_line("rgbavatar", "check", dst)
    train = command_line("ns-train", "rgbavatar", "--data", dst)
    console.print(f"Then: {look}; {train}")
