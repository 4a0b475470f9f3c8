"""Teeth for FLAME, which has none: strips built behind its lips."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.joints import JAW, NECK

UPPER_LIP = (
    *(1713, 1715, 1716, 1735, 1696, 1694, 1657, 3543),
    *(2774, 2811, 2813, 2850, 2833, 2832, 2830),
)
"""FLAME's vertices along the upper lip, from the subject's left corner to the right one."""
LOWER_LIP = (
    *(1576, 1577, 1773, 1774, 1795, 1802, 1865, 3503),
    *(2948, 2905, 2898, 2881, 2880, 2713, 2712),
)
"""The same along the lower lip."""

TeethForm = Literal["strips", "blocks"]
"""strips: 60 vertices, 56 faces, as RGBAvatar's release; blocks: 120 vertices, 168 faces in the
order of VHAP and GaussianAvatars, whose `static_offset` counts them (5,023 + 120)."""

_COLUMNS = len(UPPER_LIP)
# Shares of the mouth's width (some 50 mm): how far the teeth lie behind the lips and the lower
# ones behind the upper, how far those bite over them, their height, and their thickness.
_BEHIND, _OVERJET, _OVERBITE, _HEIGHT, _THICKNESS = 0.14, 0.03, 0.04, 0.18, 0.1
_UV_LEFT, _UV_RIGHT, _UV_BOTTOM, _UV_TOP = 0.25, 0.75, 0.955, 0.995


@dataclass(frozen=True)
class _Row:
    """15 vertices from the subject's left to the right: a root or an edge, in front or behind."""

    upper: bool
    root: bool
    behind: bool


_ENDS = (True, False)
_STRIP_ROWS = tuple(_Row(upper, root, behind=False) for root in _ENDS for upper in _ENDS)
_BACK_ROWS = tuple(_Row(upper, root, behind=True) for upper in _ENDS for root in _ENDS)
_STRIPS = ((0, 2), (3, 1))
"""Rows above and below of each strip that is seen from the front."""
_BLOCKS = (*_STRIPS, (5, 4), (6, 7), (2, 5), (7, 3))
"""Also seen from behind, and the biting edges."""


def with_teeth(arrays: HeadArrays, form: TeethForm = "strips") -> HeadArrays:
    """FLAME's arrays with teeth appended; the arrays must have FLAME's 5,023 vertices.

    They take the mean of both lips' identity directions; expressions, pose and eyelids leave them
    alone. The upper row follows the neck, the lower the jaw. In the UV map they take the strip
    u in [.25, .75], v in [.955, .995], which FLAME's own map leaves free. Positions are ours:
    behind the middle line of the lips, measured in widths of the mouth.
    """
    rows = _STRIP_ROWS + (_BACK_ROWS if form == "blocks" else ())
    strips = _BLOCKS if form == "blocks" else _STRIPS
    upper, lower = np.array(UPPER_LIP), np.array(LOWER_LIP)
    vertices = len(arrays.v_template)
    count = _COLUMNS * len(rows)
    follows = np.repeat([NECK if row.upper else JAW for row in rows], _COLUMNS)
    weights = np.eye(5, dtype=arrays.skinning_weights.dtype)[follows]
    directions = np.zeros((count, *arrays.shapedirs.shape[1:]), arrays.shapedirs.dtype)
    lips = (arrays.shapedirs[upper] + arrays.shapedirs[lower]) / 2
    identity = np.s_[..., : arrays.num_identity]
    directions[identity] = np.tile(lips[identity], (len(rows), 1, 1))
    positions = _positions(arrays.v_template[upper], arrays.v_template[lower], rows)
    triangles = _strip_triangles(
        bool(arrays.v_template[upper[0], 0] > arrays.v_template[upper[-1], 0])
    )
    below, column = np.divmod(triangles, _COLUMNS)
    faces = np.concatenate([np.array(strip)[below] * _COLUMNS + column for strip in strips])
    uv, uv_faces = _uv_strips(len(strips), triangles)
    places = vertices + np.arange(count)
    groups = dict(arrays.vertex_groups)
    groups["upper_teeth"] = places[follows == NECK]
    groups["lower_teeth"] = places[follows == JAW]
    eyelids = arrays.eyelid_dirs
    return replace(
        arrays,
        v_template=_below(arrays.v_template, positions),
        shapedirs=_below(arrays.shapedirs, directions),
        posedirs=_below(arrays.posedirs, np.zeros((count, 3, 36))),
        joint_regressor=np.pad(arrays.joint_regressor, ((0, 0), (0, count))),
        skinning_weights=_below(arrays.skinning_weights, weights),
        faces=_below(arrays.faces, faces + vertices),
        uv=_below(arrays.uv, uv),
        uv_faces=_below(arrays.uv_faces, uv_faces + len(arrays.uv)),
        eyelid_dirs=None if eyelids is None else _below(eyelids, np.zeros((count, 3, 2))),
        vertex_groups=groups,
    )


def _below(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    return np.concatenate([above, below.astype(above.dtype)])


def _positions(
    upper: Float[np.ndarray, "15 3"], lower: Float[np.ndarray, "15 3"], rows: tuple[_Row, ...]
) -> Float[np.ndarray, "T 3"]:
    """Rows of teeth behind the lips' middle line, which is made level."""
    middle = (upper + lower) / 2
    middle[:, 1] = middle[:, 1].mean()
    width = abs(float(middle[0, 0] - middle[-1, 0]))
    placed = []
    for row in rows:
        # The lower edge is level with the closed lips, the upper one hangs before it.
        up = -_OVERBITE + _HEIGHT * row.root if row.upper else -_HEIGHT * row.root
        back = _BEHIND + _OVERJET * (not row.upper) + _THICKNESS * row.behind
        placed.append(middle + np.array([0, up, -back]) * width)
    return np.concatenate(placed)


def _strip_triangles(from_left: bool) -> Int[np.ndarray, "28 3"]:
    """Two triangles a column between a row above (0 to 14) and one below (15 to 29).

    from_left: whether columns run from +x, on the right of a picture, to -x; the triangles face
    the viewer of that picture.
    """
    a = np.arange(_COLUMNS - 1)
    b, c, d = a + 1, a + _COLUMNS, a + _COLUMNS + 1
    triangles = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return triangles if from_left else triangles[:, ::-1]


def _uv_strips(
    count: int, triangles: Int[np.ndarray, "28 3"]
) -> tuple[Float[np.ndarray, "VT 2"], Int[np.ndarray, "F 3"]]:
    """UV coordinates strip under strip, so that no two triangles share a texel."""
    u = np.linspace(_UV_RIGHT, _UV_LEFT, _COLUMNS)
    pitch = (_UV_TOP - _UV_BOTTOM) / count
    tops = _UV_TOP - pitch * np.arange(count)
    # A tenth of a strip's height stays free below it.
    uv = [np.stack([u, np.full_like(u, v)], 1) for top in tops for v in (top, top - 0.9 * pitch)]
    uv_faces = [triangles + 2 * _COLUMNS * strip for strip in range(count)]
    return np.concatenate(uv), np.concatenate(uv_faces)
