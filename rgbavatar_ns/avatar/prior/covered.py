"""What lies within a head is not seen, from wherever one looks at it."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.prior.front import FrontSurface
from rgbavatar_ns.avatar.prior.mesh_field import MeshField, ramp

_WAY_M = (0.0, 0.02, 0.045, 0.08)
"""Distances on the way to the eye at which is asked how deep within the head that leads: by the
last of them it has left the head, or was deep before."""
_COVERED_M = 0.01, 0.02
"""Depths from which something counts as covered, and is altogether. Ours: from 8 mm on, faces that
were filmed lost a little; from 15 on, foreheads still showed where discs behind them end."""


@dataclass(frozen=True)
class HeadSolid:
    """All that is between the foremost and the hindmost surface of the mesh at rest."""

    front: FrontSurface
    ends_m: Float[Tensor, "2 rows columns"]
    """z of the foremost surface and minus z of the hindmost one, as `front` lays them out, within a
    rim of a pixel; minus infinity beside the mesh."""
    upright: Float[Tensor, "2 rows columns"]
    """The cosine of either surface's slope, by which depth along z becomes distance from it."""

    @classmethod
    def of(cls, avatar: Avatar, field: MeshField, front: FrontSurface) -> "HeadSolid":
        """The solid whose foremost surface is `front`."""
        back = FrontSurface.of(avatar, field, from_behind=True)
        surfaces_m, nothing = torch.stack([front.depth_m, back.depth_m]), -torch.inf
        down, right = torch.gradient(surfaces_m, dim=(1, 2))
        steep = (down.square() + right.square()).sqrt() * front.px_per_m[0]
        # A pixel on, a side may be steeper.
        upright = (1 + F.max_pool2d(steep, 3, 1, 1).square()).rsqrt()
        rim = 1, 1, 1, 1
        ends_m = F.pad(surfaces_m.where(front.there, nothing), rim, value=nothing)
        return cls(front, ends_m, F.pad(upright, rim, value=1.0))

    def depth_m(self, places_m: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """How deep within places lie, about as far from the surface; 0 outside."""
        rows, columns = self.ends_m.shape[1:]
        px = (places_m[..., :2] - self.front.corner_m) * self.front.px_per_m
        column, row = (px.round().long() + 1).unbind(-1)
        pixel = row.clamp(0, rows - 1) * columns + column.clamp(0, columns - 1)
        ahead, behind = (end.flatten()[pixel] for end in self.ends_m)
        before, after = (part.flatten()[pixel] for part in self.upright)
        z = places_m[..., 2]
        deep = ((ahead - z) * before).minimum((behind + z) * after)
        return deep.nan_to_num(nan=0.0).clamp(min=0)

    def covered(
        self,
        places_m: Float[Tensor, "N 3"],
        to_eye: Float[Tensor, "B 3"],
        inset_m: Float[Tensor, "N"] | float = 0.0,
    ) -> Float[Tensor, "B N"]:
        """1 where the way from places on the head at rest to each of B eyes leads through it.

        to_eye: unit vectors in the head's axes; inset_m: how far the person's own surface lies
        within the mesh there. Ours, because large discs of sides, eye sockets and backs paint skin
        that training leaves half clear from behind: from in front that is all the same, and on a
        head turned by 15 degrees a cheek or forehead shows where they end.
        """
        deepest = places_m.new_zeros(len(to_eye), len(places_m))
        for away_m in _WAY_M:
            deepest = deepest.maximum(self.depth_m(places_m + away_m * to_eye[:, None]))
        return ramp(deepest - inset_m, *_COVERED_M)
