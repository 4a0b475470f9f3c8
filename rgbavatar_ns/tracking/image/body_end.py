"""Where a filmed body ends: at the same place of its clothes in every frame, over a few rows.

Ours: a body that ended where each picture does would be there and gone at the same place of the
shirt, as the person leans, and an avatar that learns from both is torn there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.joints import ROOT
from rgbavatar_ns.head.surface import vertex_normals

# Over which share of the picture's height a body fades out.
_FADE = 0.04
# So many of the frames show where the body ends; in the others it goes on to the picture's edge.
_SHOWN_SHARE = 0.25
# What faces the camera of somebody upright before it.
_FRONT = 0.3
_LEAST_FADE_M = 1e-6
# Whose picture is so much narrower than high is seen from its side.
_SIDEWAYS = 0.3


@dataclass(frozen=True)
class BodyEnd:
    """A height of the body at rest, in metres: below it is nothing, above it all, `fade_m` later.

    Heights are told from the front of the chest: `vertices` of the mesh, whose places at rest are
    `places_m` (across, up).
    """

    vertices: Int[np.ndarray, "P"]
    places_m: Float[np.ndarray, "P 2"]
    height_m: float
    fade_m: float

    @classmethod
    def of(
        cls,
        arrays: HeadArrays,
        frames_px: Sequence[Float[np.ndarray, "V 2"]],
        inside: Bool[np.ndarray, "S S"],
    ) -> "BodyEnd":
        """Where the body of some frames of a clip is to end, by the mesh in their crops.

        `inside` is where these show the film.
        """
        rest = np.asarray(arrays.v_template, np.float64)
        faces = torch.from_numpy(np.asarray(arrays.faces)).long()
        normals = vertex_normals(torch.from_numpy(rest)[None], faces)[0].numpy()
        torso = arrays.vertex_groups["torso"]
        vertices = torso[normals[torso, 2] > _FRONT]
        places_m = rest[vertices, :2]
        rows, size = np.flatnonzero(inside.any(1)), len(inside)
        last = rows[-1] + 1 if len(rows) else size
        lowest_m, m_per_px = [], []
        for vertices_px in frames_px:
            seen_px = vertices_px[vertices]
            x, y, start = _height_by_px(places_m, seen_px)
            lowest_m.append(x * seen_px[:, 0].mean() + y * last + start)
            m_per_px.append(abs(y))
        fade_m = max(_FADE * size * float(np.median(m_per_px)), _LEAST_FADE_M)
        # Above the joint that the neck stands on heads move beside what a body's height tells.
        neck_foot_m = float(arrays.joint_regressor[ROOT] @ rest[:, 1])
        height_m = min(float(np.quantile(lowest_m, _SHOWN_SHARE)), neck_foot_m)
        return cls(vertices, places_m, height_m, fade_m)

    def shown(self, vertices_px: Float[np.ndarray, "V 2"], size: int) -> Float[np.ndarray, "S S"]:
        """How much is left of each pixel of a frame: 1 well above the end, 0 from there on."""
        x, y, start = _height_by_px(self.places_m, vertices_px[self.vertices])
        centre = np.arange(size) + 0.5
        height_m = x * centre[None] + y * centre[:, None] + start
        share = ((height_m - self.height_m) / self.fade_m).clip(0, 1).astype(np.float32)
        return share * share * (3 - 2 * share)


def _height_by_px(
    places_m: Float[np.ndarray, "P 2"], places_px: Float[np.ndarray, "P 2"]
) -> tuple[float, float, float]:
    """Metres of the body's height for a pixel to the right and one down, and at the corner."""
    ones = np.ones((len(places_m), 1))
    by_place = np.linalg.lstsq(np.concatenate([places_m, ones], axis=1), places_px, rcond=None)[0]
    # Of a chest seen from its side, only the way up is known.
    x, y = np.linalg.pinv(by_place[:2].T, rcond=_SIDEWAYS)[1].tolist()
    return x, y, -float(by_place[2] @ (x, y))
