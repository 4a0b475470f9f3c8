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
from rgbavatar_ns.head.surface import vertex_normals

# Over which share of the picture's height a body fades out.
_FADE = 0.04
# So many of the frames show where the body ends; in the others it goes on to the picture's edge.
_SHOWN_SHARE = 0.25
# What faces the camera of somebody upright before it.
_FRONT = 0.3


@dataclass(frozen=True)
class BodyEnd:
    """A height of the body at rest, in metres: below it is nothing, above it all, `fade_m` later.

    Heights are told from the front of the chest, whose `places_m` (across, up) belong to these
    `vertices` of the mesh.
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
        places = rest[vertices, :2]
        rows = np.flatnonzero(inside.any(1))
        size, last = len(inside), rows[-1] + 1 if len(rows) else len(inside)
        lowest, px_per_m = [], []
        for vertices_px in frames_px:
            turned, shift = _affine(places, vertices_px[vertices])
            # The body's middle, at the picture's lower edge.
            lowest.append((last - shift[1]) / turned[1, 1])
            px_per_m.append(np.linalg.norm(turned[:, 1]))
        fade_m = _FADE * size / float(np.median(px_per_m))
        return cls(vertices, places, float(np.quantile(lowest, _SHOWN_SHARE)), fade_m)

    def shown(self, vertices_px: Float[np.ndarray, "V 2"], size: int) -> Float[np.ndarray, "S S"]:
        """How much is left of each pixel of a frame: 1 well above the end, 0 from there on."""
        turned, shift = _affine(self.places_m, vertices_px[self.vertices])
        up = np.linalg.inv(turned)[1]
        centre = np.arange(size) + 0.5
        height_m = up[0] * (centre - shift[0])[None] + up[1] * (centre - shift[1])[:, None]
        share = ((height_m - self.height_m) / self.fade_m).clip(0, 1).astype(np.float32)
        return share * share * (3 - 2 * share)


def _affine(
    places_m: Float[np.ndarray, "P 2"], places_px: Float[np.ndarray, "P 2"]
) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, "2"]]:
    """The affine map nearest to carrying places to pixels: a matrix, then a shift."""
    ones = np.concatenate([places_m, np.ones((len(places_m), 1))], axis=1)
    found = np.linalg.lstsq(ones, places_px, rcond=None)[0]
    return found[:2].T, found[2]
