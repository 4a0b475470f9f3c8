"""The person's colours: textures painted once as functions of the place on the template head."""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage

from rgbavatar_ns.head import HeadArrays, uv_anchors
from rgbavatar_ns.synthetic.performer import regions
from rgbavatar_ns.synthetic.performer.noise import fractal_noise, value_noise
from rgbavatar_ns.synthetic.performer.regions import Points, bump, smooth
from rgbavatar_ns.synthetic.performer.wrinkles import wrinkle_depths

_SKIN = np.array([0.545, 0.345, 0.255])
_HAIR = np.array([0.060, 0.034, 0.020])
_SHIRT = np.array([0.055, 0.105, 0.165])
_WRINKLE_DEPTH_M = np.array([0.85, 0.55, 1.25, 0.75, 0.45, 0.5]) * 1e-3


def wrinkle_heights_m(p: Points) -> Float[np.ndarray, "N W"]:
    """Height of each fully folded group of wrinkles over the skin at rest."""
    return wrinkle_depths(p) * _WRINKLE_DEPTH_M.astype(np.float32)


class Paint:
    """Textures over the head's UV map (row 0 at v = 1): colour, gloss, and how the surface tilts.

    `relief_m` are fixed heights (pores, hair), `wrinkles_m` those of each fully folded group;
    `cheeks` is where blood shows; `metres_per_texel` goes to the right and upwards.
    """

    def __init__(
        self,
        color: Float[np.ndarray, "R R 4"],
        relief_m: Float[np.ndarray, "R R"],
        wrinkles_m: Float[np.ndarray, "R R W"],
        cheeks: Float[np.ndarray, "R R"],
        metres_per_texel: Float[np.ndarray, "R R 2"],
    ) -> None:
        self._color = color
        self._slope = _slopes(relief_m, metres_per_texel)
        groups = [_slopes(height, metres_per_texel) for height in np.moveaxis(wrinkles_m, -1, 0)]
        slopes = np.stack(groups, -1)
        changing = (np.abs(wrinkles_m).max(-1) > 1e-6) | (cheeks > 0.01)
        changing |= np.abs(slopes).max((-1, -2)) > 1e-3
        self._changing = np.flatnonzero(changing)
        self._wrinkles_m = wrinkles_m[changing]
        self._slopes = slopes[changing]
        self._cheeks = cheeks[changing]

    def folded(
        self, activations: Float[np.ndarray, "W"], blush: float
    ) -> tuple[Float[np.ndarray, "R R 4"], Float[np.ndarray, "R R 2"]]:
        """Colour and gloss, and the surface's slope to the right and upwards, of one frame."""
        folds = activations.astype(np.float32)
        heights = self._wrinkles_m @ folds * np.float32(1 / 8e-4)
        # Valleys see less of the sky and gather blood; rolls are stretched and pale.
        valley, roll = np.clip(-heights, 0, 1), np.clip(heights, 0, 1)
        flush = np.float32(blush) * self._cheeks
        color, slope = self._color.copy(), self._slope.copy()
        flat = color.reshape(-1, 4)
        factor = np.ones((len(flush), 4), np.float32)
        for channel, (dark, glow) in enumerate(((0.45, 0.06), (0.57, -0.19), (0.57, -0.17))):
            factor[:, channel] = (1 - dark * valley + 0.1 * roll) * (1 + glow * flush)
        flat[self._changing] *= factor
        slope.reshape(-1, 2)[self._changing] += self._slopes @ folds
        return color, slope


def _slopes(
    height_m: Float[np.ndarray, "R R"], metres_per_texel: Float[np.ndarray, "R R 2"]
) -> Float[np.ndarray, "R R 2"]:
    """Slope of a height map to the right and upwards."""
    height_m = np.ascontiguousarray(height_m)
    right = cv2.Sobel(height_m, -1, 1, 0, ksize=3, scale=0.125)
    up = cv2.Sobel(height_m, -1, 0, 1, ksize=3, scale=-0.125)
    return np.stack([right, up], -1) / metres_per_texel


def paint_head(
    arrays: HeadArrays, resolution: int, seed: int, wrinkles: float, scalp_hair: bool = True
) -> Paint:
    """Paint textures of `resolution` texels a side; `wrinkles` scales the folds' depth.

    Without `scalp_hair` the scalp is skin.
    """
    anchors = uv_anchors(torch.from_numpy(arrays.uv), torch.from_numpy(arrays.uv_faces), resolution)
    triangle = anchors.triangle_index.numpy()
    corners = arrays.v_template[arrays.faces[triangle]]
    p = (corners * anchors.barycentric.numpy()[..., None]).sum(1).astype(np.float32)
    inner = {
        name: np.isin(arrays.faces[:, 0], arrays.vertex_groups[name])[triangle]
        for name in ("left_eye", "right_eye", "upper_teeth", "lower_teeth", "tongue")
    }
    color, gloss, relief = _skin(p, seed, scalp_hair)
    for paint, parts in ((_teeth, ("upper_teeth", "lower_teeth")), (_tongue, ("tongue",))):
        where = np.logical_or.reduce([inner[part] for part in parts])
        color[where], gloss[where] = paint(p[where])
    outer = ~np.logical_or.reduce(list(inner.values()))
    relief = relief * outer
    heights = wrinkle_heights_m(p) * (outer * wrinkles)[:, None].astype(np.float32)
    columns = [color, gloss[:, None], relief[:, None], regions.cheeks(p)[:, None], heights]
    columns.append(_texel_lengths(arrays, triangle, resolution))
    maps = _spread(np.concatenate(columns, 1), anchors.texel_row_col.numpy(), resolution)
    return Paint(
        color=np.ascontiguousarray(maps[..., :4]),
        relief_m=maps[..., 4],
        cheeks=maps[..., 5],
        wrinkles_m=maps[..., 6:-2],
        metres_per_texel=np.maximum(maps[..., -2:], 1e-5),
    )


def _spread(values: np.ndarray, row_col: np.ndarray, resolution: int) -> np.ndarray:
    """Values of covered texels as a map; the others take those of the nearest covered texel."""
    covered = np.zeros((resolution, resolution), bool)
    covered[row_col[:, 0], row_col[:, 1]] = True
    nearest = np.zeros((2, *covered.shape), np.int32)
    ndimage.distance_transform_edt(
        ~covered, return_distances=False, return_indices=True, indices=nearest
    )
    filled = np.zeros((resolution, resolution, values.shape[1]), np.float32)
    filled[row_col[:, 0], row_col[:, 1]] = values
    return filled[nearest[0], nearest[1]]


def _texel_lengths(arrays: HeadArrays, triangle: np.ndarray, resolution: int) -> np.ndarray:
    """Metres a texel is long along u and along v, for each texel's triangle."""
    corners = arrays.v_template[arrays.faces]
    uv = arrays.uv[arrays.uv_faces]
    edges = corners[:, 1:] - corners[:, :1]
    uv_edges = (uv[:, 1:] - uv[:, :1]).astype(np.float64)
    tangents = np.linalg.solve(uv_edges, edges.astype(np.float64))
    return (np.linalg.norm(tangents, axis=2) / resolution)[triangle].astype(np.float32)


def _skin(p: Points, seed: int, scalp_hair: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour, gloss and relief of everything but eyes, teeth and tongue."""
    x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
    color = np.tile(_SKIN, (len(p), 1))
    blotches = fractal_noise(p * 70, seed + 1, 3)
    pores = value_noise(p * 900, seed + 2)
    warm = regions.cheeks(p) * 0.9 + bump(x, 0, 0.012) * bump(y, -0.004, 0.010) * (z > 0.05)
    warm += smooth(x, 0.070, 0.076) * 0.8 + 0.5 * bump(x, 0, 0.015) * bump(y, -0.068, 0.01)
    hollow = bump(x, 0.026, 0.011) * bump(y, 0.0145, 0.0055) * (z > 0.02)
    lid = bump(x, 0.030, 0.012) * bump(y, 0.0385, 0.004) * (z > 0.02)
    tint = 1 + 0.07 * blotches[:, None] + 0.05 * pores[:, None]
    tint = tint * (1 + warm[:, None] * np.array([0.02, -0.16, -0.17]))
    tint = tint * (1 - (hollow + 0.7 * lid)[:, None] * np.array([0.20, 0.24, 0.14]))
    color = color * tint
    freckles = smooth(value_noise(p * 420, seed + 3), 0.45, 0.75) * smooth(x, 0.062, 0.04)
    freckles *= bump(y, 0.002, 0.016) * (z > 0.02) * 0.28
    color = color * (1 - freckles[:, None] * np.array([0.7, 0.95, 1.0]))
    hairs = smooth(value_noise(p * 1900, seed + 4), 0.05, 0.6)
    beard = regions.stubble(p) * (0.30 + 0.45 * hairs)
    color = _mix(color, np.array([0.12, 0.085, 0.07]), beard * 0.75)
    for spot, radius in (((0.031, -0.021), 0.0014), ((-0.043, 0.001), 0.0011)):
        mole = smooth(np.hypot(p[:, 0] - spot[0], y - spot[1]), radius, radius * 0.6) * (z > 0.02)
        color = _mix(color, np.array([0.10, 0.05, 0.035]), mole * 0.85)
    gloss = 0.22 + 0.16 * bump(x, 0, 0.014) * (z > 0.03) + 0.06 * pores
    relief = 3.0e-5 * pores * (z > 0)
    return _dress(p, seed, scalp_hair, color, gloss, relief)


def _dress(
    p: Points,
    seed: int,
    scalp_hair: bool,
    color: np.ndarray,
    gloss: np.ndarray,
    relief: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lips, lashes, the inside of the mouth, brows, hair and the shirt, in this order."""
    lips = regions.lips(p)
    creases = value_noise(p * np.array([900, 120, 300]), seed + 5)
    lip_color = np.array([0.40, 0.150, 0.135]) * (1 + 0.16 * creases[:, None])
    color, gloss = _mix(color, lip_color, lips), gloss + 0.35 * lips
    relief = relief + 6e-5 * creases * lips
    mouth = smooth(p[:, 2], 0.047, 0.040) * bump(p[:, 1], -0.037, 0.012)
    # Skin behind the lips rather than the cheeks beside them: far from the face's front.
    front = 0.0505 - 22.0 * p[:, 0] ** 2
    behind = smooth(p[:, 2], front - 0.002, front - 0.006)
    mouth *= smooth(np.abs(p[:, 0]), 0.030, 0.024) * (p[:, 2] > -0.03) * behind
    color = _mix(color, np.array([0.16, 0.035, 0.035]), mouth)
    lashes = regions.near_lid_edge(p, 0.0154)
    color = _mix(color, np.array([0.045, 0.028, 0.022]), 0.9 * lashes)
    strands = value_noise(p * np.array([700, 500, 500]) + p[:, 1:2] * 500, seed + 6)
    brow = regions.brows(p) * smooth(strands, -1.1, -0.1)
    color, gloss = _mix(color, _HAIR * 0.9, 0.92 * brow), gloss * (1 - 0.6 * brow)
    if scalp_hair:
        color, gloss, relief = _hair(p, seed, color, gloss, relief)
    shirt = regions.shirt(p)
    threads = np.sin(p[:, 0] * 2 * np.pi / 0.0042) * np.sin(p[:, 1] * 2 * np.pi / 0.0042)
    stripe = smooth(np.sin(p[:, 1] * 2 * np.pi / 0.022 + 1.2), 0.55, 0.75)
    cloth = _SHIRT * (1 + 0.12 * threads[:, None])
    cloth = _mix(cloth, np.array([0.55, 0.53, 0.48]), stripe)
    collar = np.clip(regions.shirt(p) - regions.shirt(p + np.array([0, 0.006, 0])), 0, 1)
    color = _mix(color, _mix(cloth, _SHIRT * 0.5, collar), shirt)
    return (
        color.astype(np.float32),
        (gloss * (1 - shirt)).astype(np.float32),
        (relief * (1 - shirt)).astype(np.float32),
    )


def _hair(
    p: Points, seed: int, color: np.ndarray, gloss: np.ndarray, relief: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    frayed = regions.above_hairline_m(p) + 0.006 * value_noise(
        p * np.array([420, 110, 260]), seed + 7
    )
    hair = smooth(frayed, -0.004, 0.008)
    hair_color, hair_gloss, hair_relief = strands_of_hair(p, seed)
    color = _mix(color, hair_color, hair)
    return color, gloss + (hair_gloss - gloss) * hair, relief + (hair_relief - relief) * hair


def strands_of_hair(p: Points, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour [N, 3], gloss [N] and relief [N] in metres of hair at points on a head."""
    # Combed back on top, down on the sides.
    side = smooth(np.abs(p[:, 0]), 0.035, 0.060)[:, None]
    top_way, side_way = np.array([520, 140, 60]), np.array([520, 60, 520])
    curl = 0.004 * fractal_noise(p * 60, seed + 8, 2)[:, None]
    strands = (1 - side) * value_noise((p + curl) * top_way, seed + 9)[:, None]
    strands = strands + side * value_noise((p + curl) * side_way, seed + 10)[:, None]
    locks = fractal_noise((p + curl) * np.array([130, 60, 40]), seed + 11, 2)[:, None]
    shade = np.clip(1 + 0.38 * strands + 0.32 * locks, 0.25, 2.2)
    return _HAIR * shade, 0.30 + 0.25 * strands[:, 0], 2.2e-4 * (strands + 0.8 * locks)[:, 0]


def _teeth(p: Points) -> tuple[np.ndarray, np.ndarray]:
    place = np.abs(np.sin(np.pi * p[:, 0] / 0.0078))
    gap = smooth(place, 0.16, 0.03)
    gum = np.clip(
        np.maximum(smooth(p[:, 1], -0.0255, -0.0235), smooth(p[:, 1], -0.045, -0.047)), 0, 1
    )
    color = np.array([0.66, 0.61, 0.50]) * (1 - 0.55 * gap[:, None])
    color = _mix(color, np.array([0.42, 0.16, 0.15]), gum)
    return color.astype(np.float32), np.full(len(p), 0.55, np.float32)


def _tongue(p: Points) -> tuple[np.ndarray, np.ndarray]:
    spots = value_noise(p * 700, 31)
    color = np.array([0.42, 0.145, 0.135]) * (1 + 0.15 * spots[:, None])
    color *= 1 - 0.3 * bump(p[:, 0], 0, 0.0018)[:, None]
    return color.astype(np.float32), np.full(len(p), 0.5, np.float32)


def paint_eye(p: Points) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N"]]:
    """Colour and gloss of an eyeball at points of the template head, whose eyes look ahead."""
    side = np.where(p[:, 0] > 0, 1.0, -1.0)
    centre = regions.EYE_CENTRE_M * np.stack([side, side * 0 + 1, side * 0 + 1], 1)
    ray = p - centre
    radius = np.hypot(ray[:, 0], ray[:, 1]) + (ray[:, 2] < 0)
    angle = np.arctan2(ray[:, 1], ray[:, 0])
    ring = np.stack([np.cos(angle) * 9, np.sin(angle) * 9, radius * 300], 1)
    fibres = fractal_noise(ring, 41, 2)
    iris = np.array([0.115, 0.175, 0.165]) * (1 + 0.55 * fibres[:, None])
    iris = _mix(iris, np.array([0.26, 0.17, 0.07]), smooth(radius, 0.0038, 0.0022) * 0.7)
    iris = _mix(iris, np.array([0.020, 0.028, 0.030]), smooth(radius, 0.0046, 0.0056))
    iris = _mix(iris, np.array([0.006, 0.006, 0.007]), smooth(radius, 0.0023, 0.0019))
    veins = smooth(fractal_noise(p * np.array([250, 900, 400]), 43, 2), 0.2, 0.7)
    corner = smooth(np.abs(ray[:, 0]), 0.006, 0.013)
    white = np.array([0.66, 0.62, 0.59]) * (1 - (0.35 * corner * veins)[:, None] * [0.15, 0.8, 0.8])
    white = white * (1 - corner[:, None] * np.array([0.10, 0.24, 0.26]))
    color = _mix(white, iris, smooth(radius, 0.0059, 0.0054))
    return color.astype(np.float32), np.full(len(p), 0.9, np.float32)


def _mix(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    return first + (second - first) * share[:, None]
