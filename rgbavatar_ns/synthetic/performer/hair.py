"""Hair and hats: how much grows on the scalp, and what stands or hangs off the head beside.

Ours: a tracker that is only ever shown one hair cut learns to take it for the skull.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.synthetic.performer.glasses import Mesh, joined
from rgbavatar_ns.synthetic.performer.noise import fractal_noise, value_noise
from rgbavatar_ns.synthetic.performer.paint import strands_of_hair
from rgbavatar_ns.synthetic.performer.regions import Points, smooth
from rgbavatar_ns.synthetic.performer.surface import face_normals, incidence, unit

HairStyle = Literal["short", "long", "bald", "bun", "hat"]
SCALP_HAIR: dict[HairStyle, float] = {
    "short": 1.0,
    "long": 0.5,
    "bald": 0.0,
    "bun": 0.35,  # combed back tightly
    "hat": 0.35,  # pressed down
}
"""How high hair stands on the scalp itself, by the height of a short cut (6 to 14 mm)."""

# Shells are drawn around this point of the template, between the ears' tops, in rows from the
# crown down and columns around, from the back over the sides to the front.
_CENTRE_M = np.array([0.0, 0.03, -0.035])
_COLUMNS, _DOME_ROWS, _CURTAIN_ROWS = 144, 36, 28
_AROUND_COS = np.cos(0.16)  # what lies so near to a direction is covered there
# Long hair: how far it stands off, where it ends below, and at which turn from straight ahead it
# passes from the hairline over the forehead to hanging down before the ears.
_LONG_M, _HEM_M, _PARTED_RAD = 0.014, -0.128, (1.0, 1.36)
_HAIRLINE_RAD = 0.5  # above the horizon, seen from the centre
_HAT_M, _HAT_TOP_M, _BRIM_M, _BRIM_DROP_M = 0.007, 0.014, 0.042, 0.006
_HAT_FRONT_RAD, _HAT_BACK_RAD = 0.50, 0.10
_BUN_RADIUS_M, _BUN_RAD = np.array([0.036, 0.030, 0.034]), 0.98
_FELT, _BAND = np.array([0.095, 0.110, 0.070]), np.array([0.030, 0.026, 0.024])

Paint = Callable[[Points], tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N"]]]
"""Colour and gloss at points of the piece at rest."""


@dataclass(frozen=True)
class HairPiece:
    """What is fixed to the skull beside the scalp's own hair, in the head's coordinates at rest."""

    mesh: Mesh
    paint: Paint


def make_hair_piece(
    style: HairStyle, surface: Float[np.ndarray, "V 3"], seed: int
) -> HairPiece | None:
    """The piece of a style over the person's true surface at rest; None where nothing is worn."""
    if style in ("short", "bald"):
        return None
    shell = _Shell.over(surface)

    def hair(p: Points) -> tuple[np.ndarray, np.ndarray]:
        color, gloss, _ = strands_of_hair(p, seed)
        return color.astype(np.float32), gloss.astype(np.float32)

    if style == "long":
        return HairPiece(shell.curtain(seed), hair)
    if style == "bun":
        return HairPiece(shell.bun(seed), hair)
    mesh, band_m = shell.hat()

    def felt(p: Points) -> tuple[np.ndarray, np.ndarray]:
        fuzz = 1 + 0.10 * value_noise(p * 900, seed + 13)
        above_m = p[:, 1] - band_m - _tilted_m(p)
        band = smooth(above_m, 0.0, 0.001) * smooth(above_m, 0.022, 0.021)
        color = _FELT * fuzz[:, None]
        color = color + (_BAND - color) * band[:, None]
        return color.astype(np.float32), np.full(len(p), 0.05, np.float32)

    return HairPiece(mesh, felt)


def _tilted_m(p: Points) -> Float[np.ndarray, "N"]:
    """How much higher a hat sits in front than at its centre, at points' depths."""
    return 0.32 * (p[:, 2] - _CENTRE_M[2])


@dataclass(frozen=True)
class _Shell:
    """How far a head reaches from the centre, by turn (columns) and height (rows)."""

    turn: Float[np.ndarray, "C"]
    """0 straight ahead, positive to +x."""
    reach_m: Float[np.ndarray, "R C"]
    """Rows from the zenith to the horizon; smooth, so that hair lies over the ears."""

    @classmethod
    def over(cls, surface: Float[np.ndarray, "V 3"]) -> "_Shell":
        turn = np.linspace(-np.pi, np.pi, _COLUMNS, endpoint=False)
        ray = (surface - _CENTRE_M).astype(np.float32)
        away, rows = np.linalg.norm(ray, axis=1), []
        ray /= away[:, None]
        for height in np.linspace(np.pi / 2, 0, _DOME_ROWS):
            near = _directions(height, turn).astype(np.float32) @ ray.T > _AROUND_COS
            rows.append(np.where(near, away, 0).max(1))
        reach = np.array(rows)
        for axis, wide in ((0, 2), (1, 4)):
            around = range(-wide, wide + 1)
            reach = np.mean([_shifted(reach, step, axis) for step in around], axis=0)
        return cls(turn, reach)

    def curtain(self, seed: int) -> Mesh:
        """Hair that hangs to the shoulders and leaves the face free."""
        ahead = np.abs(self.turn)
        parted = smooth(ahead, *_PARTED_RAD)
        above = np.pi / 2 - _HAIRLINE_RAD
        rows = _DOME_ROWS + _CURTAIN_ROWS
        down = np.linspace(0, 1, rows)[:, None]
        # Along each column: an angle down to the horizon, then metres straight down.
        hang_m = parted * (_CENTRE_M[1] - _HEM_M)
        drop_rad = above + parted * (np.pi / 2 - above)
        bend = drop_rad * 0.11  # metres along the dome, about
        along = down * (bend + hang_m)
        angle = np.minimum(along / bend, 1) * drop_rad
        below_m = np.maximum(along - bend, 0)
        reach = self._reach_at(angle)
        rim = smooth(1 - down, 0.0, 0.10 + 0.25 * (1 - parted))
        open_edge = parted + (1 - parted) * rim
        place = _CENTRE_M + reach[..., None] * _directions(np.pi / 2 - angle, self.turn[None])
        locks = 1 + 0.5 * fractal_noise(place.reshape(-1, 3) * (90, 18, 90), seed + 14, 2)
        thick = _LONG_M * locks.reshape(reach.shape) * open_edge + 0.001
        place = place + thick[..., None] * _directions(np.pi / 2 - angle, self.turn[None])
        place[..., 1] -= below_m
        # Falls inwards a little, to the neck.
        place[..., (0, 2)] -= (place - _CENTRE_M)[..., (0, 2)] * (0.6 * below_m.clip(0, 0.3))[
            ..., None
        ]
        return _grid_mesh(place)

    def bun(self, seed: int) -> Mesh:
        """A knot of hair high on the back of the head."""
        behind = int(np.argmax(np.abs(self.turn)))
        reach = self._reach_at(np.full((1, _COLUMNS), np.pi / 2 - _BUN_RAD))[0, behind]
        away = _directions(_BUN_RAD, np.pi)
        centre = _CENTRE_M + (reach + 0.45 * _BUN_RADIUS_M[1]) * away
        height = np.linspace(np.pi / 2, -np.pi / 2, _DOME_ROWS)[:, None]
        ball = _directions(height, self.turn[None])
        coil = 0.06 * np.sin(5 * height + 2 * self.turn[None])
        lumps = 0.10 * fractal_noise(ball.reshape(-1, 3) * 3, seed + 15, 2).reshape(coil.shape)
        return _grid_mesh(centre + ball * (1 + coil + lumps)[..., None] * _BUN_RADIUS_M)

    def hat(self) -> tuple[Mesh, float]:
        """A felt hat with a brim; and how high its rim lies over the centre's depth."""
        front = 0.5 + 0.5 * np.cos(self.turn)
        end = np.pi / 2 - (_HAT_BACK_RAD + front * (_HAT_FRONT_RAD - _HAT_BACK_RAD))
        angle = np.linspace(0, 1, _DOME_ROWS)[:, None] * end
        out = _directions(np.pi / 2 - angle, self.turn[None])
        high = smooth(np.cos(angle), 0.3, 0.8)
        reach = self._reach_at(angle) + _HAT_M + _HAT_TOP_M * high
        crown = _CENTRE_M + reach[..., None] * out
        rim = crown[-1]
        level = _directions(0.0, self.turn)
        wide = np.linspace(0, 1, 8)[:, None, None]
        brim = rim + wide * _BRIM_M * level
        brim[..., 1] -= (_BRIM_DROP_M * wide**2)[..., 0]
        band_m = float(np.mean(rim[:, 1] - _tilted_m(rim)))
        return joined([_grid_mesh(crown), _grid_mesh(brim)]), band_m

    def _reach_at(self, angle: Float[np.ndarray, "R C"]) -> Float[np.ndarray, "R C"]:
        """Reach at angles down from the zenith, column by column."""
        known = np.linspace(0, np.pi / 2, _DOME_ROWS)
        columns = [np.interp(a, known, r) for a, r in zip(angle.T, self.reach_m.T)]
        return np.stack(columns, axis=1)


def _directions(height: np.ndarray | float, turn: np.ndarray | float) -> np.ndarray:
    """Unit directions at angles above the horizon and turns from straight ahead."""
    across = np.cos(height)
    parts = np.broadcast_arrays(across * np.sin(turn), np.sin(height), across * np.cos(turn))
    return np.stack(parts, axis=-1)


def _shifted(values: np.ndarray, step: int, axis: int) -> np.ndarray:
    """Moved along an axis: around in turn, stopping at zenith and horizon in height."""
    if axis == 1:
        return np.roll(values, step, axis=1)
    return values[np.clip(np.arange(len(values)) - step, 0, len(values) - 1)]


def _grid_mesh(place: Float[np.ndarray, "R C 3"]) -> Mesh:
    """Rows of points, closed around, as triangles whose normals point outwards."""
    rows, columns = place.shape[:2]
    vertices = place.reshape(-1, 3).astype(np.float32)
    here = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(here, -1, axis=1)
    corners = here[:-1], here[1:], right[1:], right[:-1]
    a, b, c, d = (corner.reshape(-1) for corner in corners)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int64)
    normals = unit(incidence(faces, len(vertices)) @ face_normals(vertices, faces))
    return Mesh(vertices, normals.astype(np.float32), faces)
