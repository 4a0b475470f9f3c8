"""Gaussians in the compressed formats of others, which GaussForge writes."""

import importlib
from pathlib import Path
from typing import Literal

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.ply import encode_ply
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.kernels import GaussianSet

CompressedFormat = Literal["spz", "compressed.ply", "sog"]
"""As GaussForge names them: Niantic's, PlayCanvas's PLY in chunks, and its self-organised one."""


def write_compressed(path: Path, gaussians: GaussianSet, format: CompressedFormat) -> int:
    """Write one set of Gaussians (B = 1) and return how many it has.

    Quantised from what `write_ply` writes, in the same world. Raises ValueError for more than one
    set, UserError where GaussForge is not installed or gives up, or nothing can be written there.
    """
    plain = encode_ply(gaussians, with_rest=False)
    try:
        gaussforge = importlib.import_module("gaussforge")
    except ImportError:
        raise UserError(
            f"GaussForge, which writes {format}, is not installed.",
            'Install it with `pip install "gaussforge>=0.6,<1"`, or write ply or gltf.',
        ) from None
    converted = gaussforge.GaussForge().convert(plain, "ply", format)
    if "error" in converted:
        raise UserError(
            f"GaussForge could not write {format}: {converted['error']}.",
            "Update it, or write ply or gltf.",
        )
    with atomic_write(path) as partial:
        partial.write_bytes(converted["data"])
    return gaussians.means.shape[1]
