"""The room's light and how the person's materials answer it; everything linear."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.synthetic.performer.regions import smooth
from rgbavatar_ns.synthetic.performer.surface import unit

Vectors = Float[np.ndarray, "N 3"]
Values = Float[np.ndarray, "N"]

KEY_DIRECTION = unit(np.array([-0.68, 0.48, 0.58])).astype(np.float32)
"""Towards the large lamp at the upper left of the picture, the only one that casts shadows."""
KEY_SPREAD = 0.035
"""Radius of the lamp as seen from the head, in radians."""
_KEY = np.array([1.62, 1.47, 1.26], np.float32)
_FILL_DIRECTION = unit(np.array([0.75, 0.10, 0.55])).astype(np.float32)
_FILL = np.array([0.36, 0.47, 0.66], np.float32)
_RIM_DIRECTION = unit(np.array([0.70, 0.35, -0.62])).astype(np.float32)
_RIM = np.array([1.25, 1.18, 1.10], np.float32)
_SKY = np.array([0.27, 0.28, 0.31], np.float32)
_FLOOR = np.array([0.15, 0.13, 0.12], np.float32)
_WRAP = np.array([0.26, 0.12, 0.08], np.float32)


@dataclass(frozen=True)
class Samples:
    """Points where rays met the person."""

    normals: Vectors
    to_eye: Vectors
    albedo: Vectors
    gloss: Values
    """Strength of the highlight."""
    sharpness: Values
    """Exponent of the highlight."""
    translucency: Values
    """1 where light bleeds past the terminator as in skin, 0 where it does not."""
    openness: Values
    """Share of the surroundings that a point sees."""
    lit: Values
    """Share of the key lamp that a point sees."""


def shade(samples: Samples, light_to_world: Float[np.ndarray, "3 3"]) -> Vectors:
    """Light that leaves the points towards the eye: wrapped Lambert plus Blinn-Phong.

    Ours: not physical, but with what makes a face hard for a fixed colour: light that stays in
    the room while the head turns, cast shadows, highlights. `light_to_world` turns the room.
    """
    samples = replace(
        samples, normals=samples.normals @ light_to_world, to_eye=samples.to_eye @ light_to_world
    )
    n, openness = samples.normals, samples.openness[:, None]
    wrap = _WRAP * samples.translucency[:, None]
    key = (n @ KEY_DIRECTION)[:, None]
    key = np.clip((key + wrap) / (1 + wrap), 0, 1) * samples.lit[:, None]
    fill = np.clip((n @ _FILL_DIRECTION)[:, None], 0, 1) * openness
    rim = np.clip((n @ _RIM_DIRECTION)[:, None], 0, 1) * openness
    up = 0.5 + 0.5 * n[:, 1:2]
    # Light that has bounced in a cavity of flesh is redder.
    bounced = openness * (1 + (1 - openness) * np.array([0.20, -0.09, -0.13], np.float32))
    ambient = (_FLOOR + (_SKY - _FLOOR) * up) * bounced
    diffuse = samples.albedo * (_KEY * key + _FILL * fill + _RIM * rim + ambient)
    shine = _highlight(samples, KEY_DIRECTION)[:, None] * samples.lit[:, None] * _KEY
    shine = shine + _highlight(samples, _FILL_DIRECTION)[:, None] * _FILL * openness
    shine = shine + 0.5 * _highlight(samples, _RIM_DIRECTION)[:, None] * _RIM * openness
    return diffuse + shine


def _highlight(samples: Samples, towards: np.ndarray) -> Values:
    half = unit(samples.to_eye + towards)
    facing = np.clip(np.einsum("ij,ij->i", samples.normals, half), 1e-4, 1)
    lobe = np.exp(samples.sharpness * np.log(facing)) * (samples.sharpness + 8) / 60
    grazing = 1 + 3 * (1 - np.clip(half @ towards, 0, 1)) ** 3
    return samples.gloss * lobe * grazing * (samples.normals @ towards > 0)


def room(direction: Vectors) -> Values:
    """How bright the room is in each direction: two windows with curtains, and a bright ceiling.

    Their soft edges make a glare that wanders over the lenses rather than a sharp picture.
    """
    azimuth = np.arctan2(direction[:, 0], direction[:, 2])
    elevation = np.arcsin(np.clip(direction[:, 1], -1, 1))

    def window(left: float, right: float, low: float, high: float) -> np.ndarray:
        edge = 0.22
        across = smooth(azimuth, left, left + edge) * smooth(azimuth, right + edge, right)
        return across * smooth(elevation, low, low + edge) * smooth(elevation, high + edge, high)

    light = 2.9 * window(-1.05, -0.45, -0.35, 0.60) + 2.3 * window(0.42, 0.85, -0.40, 0.45)
    return 0.12 + 0.10 * np.clip(direction[:, 1], 0, 1) + light + window(-1.5, 1.5, 0.62, 1.0)


def reflection(normals: Vectors, to_eye: Vectors) -> Values:
    """Brightness that a coated lens adds, grey."""
    facing = np.einsum("ij,ij->i", normals, to_eye)
    mirrored = 2 * facing[:, None] * normals - to_eye
    mirror = 0.13 + 0.5 * (1 - np.clip(facing, 0, 1)) ** 4
    return mirror * room(mirrored)


def to_srgb(linear: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Display values in [0, 1]; highlights roll off instead of clipping."""
    soft = np.where(linear > 0.75, 0.75 + 0.25 * np.tanh((linear - 0.75) / 0.25), linear)
    soft = np.clip(soft, 0, 1)
    return np.where(
        soft <= 0.0031308, 12.92 * soft, 1.055 * np.power(np.maximum(soft, 1e-8), 1 / 2.4) - 0.055
    )
