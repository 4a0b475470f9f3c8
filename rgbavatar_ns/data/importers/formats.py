"""The formats that are known, and which of them a folder is in."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rgbavatar_ns.data.importers import (
    flashavatar,
    frame_folders,
    imavatar,
    insta,
    vhap,
    vhap_raw,
)
from rgbavatar_ns.data.importers.folder import Folder
from rgbavatar_ns.data.importers.options import ImportOptions, Progress
from rgbavatar_ns.data.importers.source import Reading, Source
from rgbavatar_ns.data.native.format import INDEX_FILE
from rgbavatar_ns.errors import UserError


@dataclass(frozen=True)
class Format:
    """One system's layout of a folder; commands call it by `key`, people by `name`.

    `takes`: those of the options for some formats alone that count here.
    """

    key: str
    name: str
    recognises: Callable[[Folder], bool]
    read: Callable[[Reading], Source]
    takes: tuple[str, ...] = ()


_OF_SOME = ("images", "masks", "region")
"""Options that only some formats take."""


FORMATS = (
    Format("vhap", "VHAP", vhap.is_vhap, vhap.read_vhap),
    Format(
        "vhap-raw", "raw VHAP", vhap_raw.is_vhap_raw, vhap_raw.read_vhap_raw, ("images", "masks")
    ),
    Format("imavatar", "IMAvatar", imavatar.is_imavatar, imavatar.read_imavatar),
    Format("insta", "INSTA", insta.is_insta, insta.read_insta),
    Format(
        "flashavatar",
        "FlashAvatar",
        flashavatar.is_flashavatar,
        flashavatar.read_flashavatar,
        ("region",),
    ),
    Format(
        "nerfblendshape",
        "NeRFBlendShape",
        frame_folders.is_nerf_blend_shape,
        frame_folders.read_nerf_blend_shape,
    ),
    Format(
        "gaussianblendshapes",
        "GaussianBlendshapes",
        frame_folders.is_gaussian_blendshapes,
        frame_folders.read_gaussian_blendshapes,
    ),
    Format("rgbavatar", "RGBAvatar", frame_folders.is_rgbavatar, frame_folders.read_rgbavatar),
    Format(
        "metrical",
        "metrical-tracker",
        frame_folders.is_metrical,
        frame_folders.read_metrical,
        ("images", "masks"),
    ),
)
"""In the order in which they are tried: the more particular first."""


def find_format(root: Path, options: ImportOptions | None = None) -> Format | None:
    """The format of a folder or of the option; None: none of these. UserError: unknown option."""
    options = options or ImportOptions()
    if options.format is not None:
        for known in FORMATS:
            if known.key == options.format:
                return known
        raise UserError(
            f"There is no format '{options.format}'.",
            f"Known are {', '.join(known.key for known in FORMATS)}.",
        )
    folder = Folder(root, options.allow_outside)
    return next((known for known in FORMATS if known.recognises(folder)), None)


def read_source(root: Path, options: ImportOptions, progress: Progress | None = None) -> Source:
    """All records of a folder of another system without its pixels; UserError if it has faults."""
    if not os.path.isdir(root):
        raise UserError(f"There is no folder {root}.", "Name the folder that holds the data.")
    found = find_format(root, options)
    if found is None and (root / INDEX_FILE).is_file():
        raise UserError(
            f"{root} is a dataset already.", f"Train on it: ns-train rgbavatar --data {root}."
        )
    if found is None:
        below = sorted(
            path.name for path in root.iterdir() if path.is_dir() and find_format(path) is not None
        )
        hint = f" Its folders {', '.join(below[:4])} are known: name one of them." if below else ""
        raise UserError(
            f"{root} is in none of the formats {', '.join(known.name for known in FORMATS)}.{hint}",
            "docs/dataset_format.md tells what each is known by; --format chooses one.",
        )
    _refuse_idle(found, options)
    return found.read(Reading(found.name, Folder(root, options.allow_outside), options, progress))


def _refuse_idle(found: Format, options: ImportOptions) -> None:
    """Raise UserError about an option that changes nothing of this format's data."""
    usual = ImportOptions()
    for name in _OF_SOME:
        if name not in found.takes and getattr(options, name) != getattr(usual, name):
            takers = " and ".join(known.name for known in FORMATS if name in known.takes)
            raise UserError(
                f"--{name} changes nothing of {found.name} data; it is for that of {takers}.",
                "Leave it out, or name another --format.",
            )
