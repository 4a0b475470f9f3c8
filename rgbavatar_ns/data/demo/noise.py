"""Smooth noise in space, the same on every machine."""

import numpy as np
from jaxtyping import Float

_PRIMES = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint32)


def value_noise(points: Float[np.ndarray, "N 3"], seed: int) -> Float[np.ndarray, "N"]:
    """Noise in [-1, 1] that varies over a unit of length: random values on the integer lattice.

    Ours: hashed lattice, blended by smoothstep.
    """
    cell = np.floor(points).astype(np.int64)
    part = (points - cell).astype(np.float32)
    blend = part * part * (3 - 2 * part)
    total = np.zeros(len(points), np.float32)
    for corner in range(8):
        offset = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        weight = np.where(offset, blend, 1 - blend).prod(1)
        total += weight * _lattice_value(cell + offset, seed)
    return total


def fractal_noise(
    points: Float[np.ndarray, "N 3"], seed: int, octaves: int = 3
) -> Float[np.ndarray, "N"]:
    """Sum of noises, each twice as fine and half as strong, scaled to about [-1, 1]."""
    total = np.zeros(len(points), np.float32)
    for octave in range(octaves):
        total += 0.5**octave * value_noise(points * 2.0**octave, seed + 101 * octave)
    return total / (2 - 0.5 ** (octaves - 1))


def _lattice_value(cell: np.ndarray, seed: int) -> np.ndarray:
    mixed = (cell & 0xFFFFFFFF).astype(np.uint32) * _PRIMES
    value = mixed[:, 0] ^ mixed[:, 1] ^ mixed[:, 2] ^ np.uint32(seed * 0x27D4EB2F & 0xFFFFFFFF)
    for shift, factor in ((15, 0x2C1B3C6D), (12, 0x297A2D39)):
        value = (value ^ (value >> np.uint32(shift))) * np.uint32(factor)
    value = value ^ (value >> np.uint32(15))
    return value.astype(np.float32) * np.float32(2 / 0xFFFFFFFF) - 1
