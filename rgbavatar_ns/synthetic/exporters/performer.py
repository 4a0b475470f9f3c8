"""`demo-data --format`: the demo subject, as a system of another format would have left it."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rgbavatar_ns.data.native.writer import UNFINISHED
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import disk_errors
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.exporters.folders import (
    FlashAvatarWriter,
    IMAvatarWriter,
    InstaWriter,
    MetricalWriter,
    TakeWriter,
    VhapWriter,
)
from rgbavatar_ns.synthetic.exporters.take import FlameFilm, Take
from rgbavatar_ns.synthetic.make import Progress


@dataclass(frozen=True)
class DemoFormat:
    """How the subject is filmed for a format, and who writes it."""

    writer: Callable[[Path, Take], TakeWriter]
    version: str
    stiff_neck: bool
    """Whether the format knows no neck."""


DEMO_FORMATS = {
    "insta": DemoFormat(InstaWriter, "2020", True),
    "metrical": DemoFormat(MetricalWriter, "2020", True),
    "vhap": DemoFormat(VhapWriter, "2023", False),
    "flashavatar": DemoFormat(FlashAvatarWriter, "2020", True),
    "imavatar": DemoFormat(IMAvatarWriter, "2020", False),
}


def write_demo(
    dst: str | Path, format: str, config: DemoConfig, progress: Progress | None = None
) -> Path:
    """Write the demo subject in a format of `DEMO_FORMATS`; returns the FLAME-shaped pickle.

    What was interrupted lies in a folder of its own in it, and is begun anew. Raises UserError
    where it holds something else, is a file or cannot be written, and for a body, which FLAME has
    not.
    """
    dst, chosen = Path(dst).resolve(), DEMO_FORMATS[format]
    if config.body != "none":
        raise UserError(
            f"FLAME, in which {format} data is, has no shoulders: --body {config.body} cannot be.",
            "Leave it out, or write --format native.",
        )
    if dst.exists() and not dst.is_dir():
        raise UserError(f"{dst} is a file.", "Name a new folder.")
    partial = dst / UNFINISHED
    if dst.exists() and any(path != partial for path in dst.iterdir()):
        raise UserError(f"The folder {dst} is not empty.", "Name a new folder.")
    # Not beside it: the folder may be the one that the user is in, or a mounted disk.
    with disk_errors(dst):
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        film = FlameFilm(partial, config, chosen.version, chosen.stiff_neck, dst.name)
        writer = chosen.writer(partial, film.take)
        for frame in film.frames():
            writer.add(frame)
            if progress is not None:
                progress(frame.index + 1, config.num_frames)
        writer.finish()
        for path in list(partial.iterdir()):
            path.rename(dst / path.name)
        partial.rmdir()
    return dst / film.flame_path.relative_to(partial)
