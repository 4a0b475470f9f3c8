"""The hairline at the nape, which no frame shows: lowest in the middle, and ragged."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from rgbavatar_ns.avatar.prior.mesh_field import NECK_HAIR_M, MeshField, ramp

_HIGHEST_M, _DEEPEST_M, _HALF_WIDTH_M = -0.002, 0.02, 0.045
"""How far above the end of the mesh's hair the line runs at the neck's sides, how much lower in the
middle, and how far aside it is all the way up."""
_RAGGED_M, _SOFT_M = 0.006, 0.002
"""By how much strands reach farther or less far, and over how far they thin out."""
_BEHIND_M = 0.095, 0.11
"""From what lies so far behind the eyes it begins, and is altogether."""
_HAIR_M, _SKIN_M = (0.0, 0.015), (-0.045, -0.025)
"""Heights over the end of the mesh's hair whose colours are hair's and skin's."""
_LOWEST_M = -0.036
"""Below it no strand reaches."""
_STRANDS = 0.01, 0.03
"""Contrasts of hair from which it ends so, and from which it does altogether: caps do not."""
_NEAREST = 4
"""Vertices whose mean colour is a Gaussian's."""


@dataclass(frozen=True)
class Nape:
    """N Gaussians near the hairline behind the neck. Ours, because meshes end their hair in a
    straight line there, as of a cap."""

    near: Float[Tensor, "N"]
    """1 where the line decides, towards 0 beside the neck; 0 on all other Gaussians."""
    hair: Float[Tensor, "N"]
    """1 above the line."""
    places: Int[Tensor, "M"]
    """Those that are near."""
    of_hair: Int[Tensor, "M K"]
    """The vertices that tell each one's colour above the line, and below it."""
    of_skin: Int[Tensor, "M K"]

    @classmethod
    def of(cls, field: MeshField, strands: Float[Tensor, "N"]) -> "Nape":
        """`strands`: noise of deviation 1, drawn out along hair that falls."""
        height_m = field.above_eyes_m + NECK_HAIR_M
        sides = field.behind_eyes_m > _BEHIND_M[0]
        known = [sides & _between(height_m, *bounds) for bounds in (_HAIR_M, _SKIN_M)]
        known = [known[0] & field.haired, known[1] & ~field.haired]
        # Aside at rest, as wide as this person's neck is.
        behind_m, up_m, aside_m = field.at_gaussians(
            torch.stack([field.behind_eyes_m, height_m, field.rest_m[:, 0]], 1)
        ).unbind(1)
        middle = (1 - (aside_m / _HALF_WIDTH_M).square()).clamp(min=0)
        line_m = _HIGHEST_M - _DEEPEST_M * middle
        hair = ramp(up_m - line_m + _RAGGED_M * strands, -_SOFT_M, _SOFT_M)
        near = ramp(behind_m, *_BEHIND_M) * _between(up_m, _LOWEST_M, _HAIR_M[1]).to(up_m)
        if not all(bool(some.any()) for some in known):
            near = torch.zeros_like(near)
        places = torch.nonzero(near)[:, 0]
        rest_m = field.at_gaussians(field.rest_m)[places]
        of_hair, of_skin = (_nearest(field.rest_m, some, rest_m) for some in known)
        return cls(near, hair, places, of_hair, of_skin)

    def colored(
        self,
        color: Float[Tensor, "N C"],
        of_vertices: Float[Tensor, "V C"],
        contrast: Float[Tensor, ""],
    ) -> Float[Tensor, "N C"]:
        """Colours of Gaussians with this line between hair and skin, where hair has strands of
        some contrast."""
        hair, skin = (of_vertices[some].mean(1) for some in (self.of_hair, self.of_skin))
        share, near = self.hair[self.places, None], self.near[self.places, None]
        near = near * ramp(contrast, *_STRANDS)
        there = torch.lerp(color[self.places], torch.lerp(skin, hair, share), near)
        return color.index_copy(0, self.places, there)


def _between(values: Tensor, low: float, high: float) -> Bool[Tensor, "*n"]:
    return (values > low) & (values < high)


def _nearest(
    vertices_m: Float[Tensor, "V 3"], some: Bool[Tensor, "V"], places_m: Float[Tensor, "M 3"]
) -> Int[Tensor, "M K"]:
    """The nearest of some vertices."""
    numbers = torch.nonzero(some)[:, 0]
    count = min(_NEAREST, len(numbers))
    if not len(places_m):
        return numbers.new_zeros(0, count)
    tree = KDTree(vertices_m[numbers].cpu().double().numpy())
    _, found = tree.query(places_m.cpu().double().numpy(), k=count)
    return numbers[torch.as_tensor(found).view(-1, count).to(numbers)]
