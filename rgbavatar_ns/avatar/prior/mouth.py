"""What is supposed of the mouth: seen through the lips alone, and dark within."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import color_from_feature, feature_from_color
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.head.mouth import Mouth
from rgbavatar_ns.head.surface import interpolated, vertex_normals
from rgbavatar_ns.kernels import PinholeCameras

_PARTED_M = 1e-3
"""By how much lips may be farther apart than they were tracked."""
_CAVITY, _TEETH, _TONGUE = (0.33, 0.2, 0.19), (0.95, 1.1, 1.12), (0.72, 0.5, 0.52)
"""Red, green and blue over those of the skin around the lips: ours, guessed once for everybody."""
_GUESSED = 0.05
"""What a guess weighs beside what is seen clearly."""
_LIPS_M, _AROUND_M = 0.012, 0.05
"""Lips reach so far from their inner rims, inwards too, where they have the colour of their fronts:
dark ones would come through where lips are pressed or pursed. And so far reaches the skin that the
mouth's colours are guessed by."""
_BACKWARDS, _RIM_M = -0.2, 0.004
"""Normals (z forwards) from which a surface is never seen from in front, farther than so from the
lips' inner rims, which turn inside out when they part."""


@dataclass(frozen=True)
class HiddenMouth:
    """The mouth of an avatar's head, of V vertices and N Gaussians. Ours.

    Because skin that training leaves half clear is painted from behind otherwise: cavity and teeth
    are seen through it, take its colour, and an opened mouth shows them.
    """

    gaussians: Int[Tensor, "G"]
    """Those of cavity, teeth and tongue."""
    behind: Float[Tensor, "N"]
    """1 at these, falling to 0 at the lips."""
    before: Float[Tensor, "N"]
    """1 within the mouth, at its lips and on the skin around, all of which hide it."""
    in_cavity: Float[Tensor, "N"]
    """The same of the cavity alone."""
    backs: Bool[Tensor, "N"]
    """Those of the cavity that face the back of the head, behind lips and cheeks: nobody sees them
    from outside, but where lips are pursed they come through."""
    corners: Int[Tensor, "G 3"]
    barycentric: Float[Tensor, "G 3"]
    rim_vertices: Int[Tensor, "R 3"]
    rim_weights: Float[Tensor, "R 3"]
    guess: Float[Tensor, "V 3"]
    """Colours over that of the skin around the lips."""
    weight: Float[Tensor, "V"]
    """What these guesses weigh: nothing outside of the mouth, little near the lips."""
    around: Float[Tensor, "V"]
    """1 on the skin around the lips."""

    @classmethod
    def of(cls, avatar: Avatar, field: MeshField) -> "HiddenMouth | None":
        """The mouth of an avatar's head, if it is known where it has one."""
        arrays = avatar.head.arrays
        mouth = Mouth.of(arrays)
        if mouth is None:
            return None
        corners, barycentric = avatar.anchors.corners()
        template = np.asarray(arrays.v_template)
        guess, weight = np.zeros_like(template), np.zeros(len(template))
        points_m = (template[mouth.rim_vertices] * mouth.rim_weights[..., None]).sum(1)
        away_m = KDTree(points_m).query(template)[0]
        for part, color, reach in (
            (mouth.cavity, _CAVITY, np.minimum(away_m / _LIPS_M, 1) ** 2),
            (mouth.teeth, _TEETH, np.ones(len(template))),
            (mouth.tongue, _TONGUE, np.ones(len(template))),
        ):
            guess[part], weight[part] = color, reach[part]
        inside, cavity = np.zeros(len(template)), np.zeros(len(template))
        inside[np.concatenate([mouth.cavity, mouth.teeth, mouth.tongue])] = 1
        cavity[mouth.cavity] = 1
        normals = vertex_normals(torch.from_numpy(template)[None], avatar.head.faces.cpu().long())
        backs = (normals[0, :, 2].numpy() < _BACKWARDS) & (away_m > _RIM_M)
        around = (inside == 0) & (away_m > _LIPS_M) & (away_m < _AROUND_M)

        def here(values: np.ndarray) -> Tensor:
            return torch.from_numpy(values).to(barycentric)

        def at_gaussians(values: np.ndarray) -> Float[Tensor, "N"]:
            return field.at_gaussians(here(values)[:, None])[:, 0]

        behind = at_gaussians(inside)
        gaussians = torch.nonzero(behind > 0.5)[:, 0]
        return cls(
            gaussians,
            behind,
            at_gaussians((away_m < _AROUND_M).astype(np.float32)),
            at_gaussians(cavity),
            at_gaussians(cavity * backs) > 0.5,
            corners[gaussians],
            barycentric[gaussians],
            torch.from_numpy(mouth.rim_vertices.astype(np.int64)).to(corners.device),
            here(mouth.rim_weights),
            here(guess),
            here(_GUESSED * weight),
            here(around.astype(np.float32)),
        )

    def through_lips(
        self,
        shown_px: Float[Tensor, "B N"],
        vertices: Float[Tensor, "B V 3"],
        cameras: PinholeCameras,
    ) -> Float[Tensor, "B N"]:
        """What frames show of each Gaussian, less what lies behind closed lips or cheeks."""
        rim = interpolated(vertices, self.rim_vertices, self.rim_weights)
        rim = rim + _PARTED_M * normalize(rim - rim.mean(1, keepdim=True), dim=-1)
        places = interpolated(vertices, self.corners, self.barycentric)
        seen = within_polygon(cameras.project(places), cameras.project(rim))
        share = torch.ones_like(shown_px).index_copy(1, self.gaussians, seen.to(shown_px))
        return shown_px * share

    def guessed(
        self, told: Float[Tensor, "V 3"], confidence: Float[Tensor, "V"]
    ) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V"]]:
        """Colour features of vertices and how sure they are, with guesses of what is in here."""
        around = (confidence * self.around)[:, None]
        skin = color_from_feature((told * around).sum(0) / around.sum().clamp(min=1e-12))
        sure = confidence + self.weight
        guess = feature_from_color(self.guess * skin)
        known = told * confidence[:, None] + guess * self.weight[:, None]
        return known / sure.clamp(min=1e-12)[:, None], sure


def within_polygon(
    points: Float[Tensor, "B P 2"], polygon: Float[Tensor, "B R 2"]
) -> Bool[Tensor, "B P"]:
    """Which points lie within a closed polygon, by the even-odd rule; waits for no device."""
    x, y = points[:, :, None].unbind(-1)
    (x_from, y_from), (x_to, y_to) = (
        ends[:, None].unbind(-1) for ends in (polygon, polygon.roll(-1, 1))
    )
    crosses = (y_from > y) != (y_to > y)
    height = torch.where(crosses, y_to - y_from, torch.ones_like(y))
    to_the_right = x_from + (y - y_from) / height * (x_to - x_from) > x
    return (crosses & to_the_right).sum(-1) % 2 == 1
