"""Smooth noise in space, the same on every machine."""

from functools import cache

import numpy as np
from jaxtyping import Float

_PERIOD = 64


def value_noise(points: Float[np.ndarray, "N 3"], seed: int) -> Float[np.ndarray, "N"]:
    """Noise in [-1, 1] that varies over a unit of length: random values on the integer lattice.

    Ours: the lattice repeats after 64 units, each seed starts at another place in it, and values
    between are blended by smoothstep.
    """
    start = np.random.PCG64(seed).random_raw(3) % _PERIOD
    cell = np.floor(points)
    part = (points - cell).astype(np.float32)
    blend = part * part * (3 - 2 * part)
    lower = (cell.astype(np.int32) + start.astype(np.int32)) & (_PERIOD - 1)
    upper = (lower + 1) & (_PERIOD - 1)
    lattice = _lattice()
    x, y, z = blend.T
    columns = [lower[:, 0] * _PERIOD**2, upper[:, 0] * _PERIOD**2]
    rows = [lower[:, 1] * _PERIOD, upper[:, 1] * _PERIOD]
    planes = []
    for depth in (lower[:, 2], upper[:, 2]):
        lines = []
        for row in rows:
            place = row + depth
            first, second = lattice[columns[0] + place], lattice[columns[1] + place]
            lines.append(first + (second - first) * x)
        planes.append(lines[0] + (lines[1] - lines[0]) * y)
    return planes[0] + (planes[1] - planes[0]) * z


def fractal_noise(
    points: Float[np.ndarray, "N 3"], seed: int, octaves: int = 3
) -> Float[np.ndarray, "N"]:
    """Sum of noises, each twice as fine and half as strong, scaled to about [-1, 1]."""
    total = np.zeros(len(points), np.float32)
    for octave in range(octaves):
        total += 0.5**octave * value_noise(points * 2.0**octave, seed + 101 * octave)
    return total / (2 - 0.5 ** (octaves - 1))


@cache
def _lattice() -> Float[np.ndarray, "_"]:
    """Values in [-1, 1]; raw bits, since numpy promises that these never change."""
    bits = np.random.PCG64(20251).random_raw(_PERIOD**3) >> np.uint64(40)
    return (bits.astype(np.float32) * np.float32(2 / (2**24 - 1)) - 1).astype(np.float32)
