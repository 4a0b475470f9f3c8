"""Which files hold Gaussians for other programs: one frame each, or a folder of a sequence."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.export.compressed import write_compressed
from rgbavatar_ns.export.gltf import write_gltf
from rgbavatar_ns.export.ply import write_ply
from rgbavatar_ns.files import keep_numbered
from rgbavatar_ns.kernels import GaussianSet


@dataclass(frozen=True)
class GaussianFile:
    """A format: how its files end, and who writes one and returns the number of Gaussians."""

    suffix: str
    write: Callable[[Path, GaussianSet], int]


GAUSSIAN_FILES = {
    "ply": GaussianFile(".ply", write_ply),
    "gltf": GaussianFile(".glb", write_gltf),
    "spz": GaussianFile(".spz", partial(write_compressed, format="spz")),
    "compressed-ply": GaussianFile(
        ".compressed.ply", partial(write_compressed, format="compressed.ply")
    ),
    "sog": GaussianFile(".sog", partial(write_compressed, format="sog")),
}
"""By the names that `rgbavatar export --format` takes; each does a frame and a sequence."""


@torch.no_grad()
def write_gaussians(
    avatar: AvatarMethod, theta: Float[Tensor, "1 H"], path: Path, format: str
) -> int:
    """Write theta's Gaussians to this file and return how many there are; raises UserError."""
    return GAUSSIAN_FILES[format].write(path, avatar.gaussians(theta))


def write_gaussian_sequence(
    avatar: AvatarMethod,
    theta: Float[Tensor, "F H"],
    places: tuple[int, ...],
    folder: Path,
    format: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a file for each frame, named after the frame's place in its film; raises UserError.

    Files of other places, of a sequence that was here before, are removed.
    """
    suffix = GAUSSIAN_FILES[format].suffix
    for done, place in enumerate(places, start=1):
        path = folder / f"{place:05d}{suffix}"
        write_gaussians(avatar, theta[place : place + 1], path, format)
        progress(done, len(places))
    keep_numbered(folder, suffix, places)
