"""Gaussians as the PLY file that viewers of 3D Gaussian splatting open."""

from pathlib import Path

import numpy as np
import torch

from rgbavatar_ns.avatar.model.blendshapes import feature_from_color
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.kernels import GaussianSet

_NUM_REST = 45
_LEAST_SCALE_M = 1e-12
_LEAST_OPACITY = 1e-6

COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(_NUM_REST)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
"""Properties of a vertex, all float, in the order of the 3DGS release (Kerbl et al. 2023)."""


def write_ply(path: Path, gaussians: GaussianSet) -> int:
    """Write one set of Gaussians (B = 1) and return how many it has.

    As in 3DGS: colour as the zeroth spherical harmonic, the 45 higher ones zero (viewers that
    read a fixed number of columns need them), normals zero, opacity as logit, scales as logs,
    unit quaternions with the real part first. World of the head model: metres, y up, the face
    looks along +z. Raises ValueError for more than one set, UserError where it cannot be written.
    """
    content = encode_ply(gaussians)
    with atomic_write(path) as partial:
        partial.write_bytes(content)
    return gaussians.means.shape[1]


def encode_ply(gaussians: GaussianSet, *, with_rest: bool = True) -> bytes:
    """Return what `write_ply` writes; the higher harmonics can be left out.

    Raises ValueError for more than one set.
    """
    if len(gaussians.means) != 1:
        raise ValueError(f"A file holds one set of Gaussians, not {len(gaussians.means)}.")
    kept = [place for place, name in enumerate(COLUMNS) if with_rest or "rest" not in name]
    table = _table(gaussians)[:, kept]
    header = "".join(f"property float {COLUMNS[place]}\n" for place in kept)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{header}end_header\n"
    )
    return header.encode("ascii") + table.tobytes()


@torch.no_grad()
def _table(gaussians: GaussianSet) -> np.ndarray:
    """[N, 62] little-endian float32 in the order of COLUMNS."""
    means = gaussians.means[0]
    opacity = gaussians.opacities[0].clamp(_LEAST_OPACITY, 1 - _LEAST_OPACITY)
    columns = [
        means,
        torch.zeros_like(means),
        feature_from_color(gaussians.colors[0]),
        means.new_zeros(len(means), _NUM_REST),
        opacity.logit()[:, None],
        gaussians.scales[0].clamp(min=_LEAST_SCALE_M).log(),
        torch.nn.functional.normalize(gaussians.quats_wxyz[0], dim=-1),
    ]
    return torch.cat(columns, 1).cpu().numpy().astype("<f4")
