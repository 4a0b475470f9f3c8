"""How far forward a head's surface lies, as it is seen from in front."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import TangentBlendshapes
from rgbavatar_ns.avatar.prior.mesh_field import MeshField, ramp
from rgbavatar_ns.head.rotations import conjugate_quats_wxyz, turn_back

_PIXEL_M = 1.5e-3
_SMOOTH_PX = 2.0
_TIP = 1.5
"""Standard deviations from its centre at which a Gaussian ends."""
_ACROSS = 0.5, 0.7
"""Sideways parts of its longest axis from which it reaches across the view, and does altogether."""
_BEFORE_M = 4e-3, 8e-3
"""From what a Gaussian's tip stands before the surface it counts, and from what altogether."""
_NEEDLE = 1.5
"""Widths of its disc that a Gaussian is longer than, if it is cut."""


@dataclass(frozen=True)
class FrontSurface:
    """The foremost surface of the mesh at rest, along the head's z axis: metres.

    Rows go down from `corner_m`, x and y of the first pixel's middle, columns to the right.
    """

    depth_m: Float[Tensor, "rows columns"]
    """Smoothed; it goes on for some pixels beside the mesh."""
    there: Bool[Tensor, "rows columns"]
    corner_m: Float[Tensor, "2"]
    px_per_m: Float[Tensor, "2"]
    last_px: Float[Tensor, "2"]

    @classmethod
    def of(cls, avatar: Avatar, field: MeshField, *, from_behind: bool = False) -> "FrontSurface":
        """Drawn from afar to near; `from_behind`, the hindmost surface, whose depth is minus z."""
        # Here, so that timing steps on a bare machine needs no OpenCV.
        import cv2

        rest_m = field.rest_m.cpu().double().numpy()
        faces = avatar.head.faces.cpu().long().numpy()
        low, high = rest_m.min(0), rest_m.max(0)
        nearness_m = rest_m[:, 2] * (-1 if from_behind else 1)
        columns, rows = (int(part / _PIXEL_M) + 2 for part in (high - low)[:2])
        px = np.stack([rest_m[:, 0] - low[0], high[1] - rest_m[:, 1]], 1) / _PIXEL_M
        corners = np.round(px[faces] * 16).astype(np.int32)
        drawn = np.full((rows, columns), np.nan, np.float32)
        forward = nearness_m[faces].mean(1)
        for face in np.argsort(forward):
            cv2.fillConvexPoly(drawn, corners[face], (float(forward[face]),), shift=4)
        there = np.isfinite(drawn)
        both = np.dstack([np.nan_to_num(drawn), there.astype(np.float32)])
        value, weight = np.moveaxis(cv2.GaussianBlur(both, (0, 0), _SMOOTH_PX), -1, 0)
        held = field.rest_m
        return cls(
            torch.from_numpy(value / weight.clip(1e-6)).to(held),
            torch.from_numpy(there).to(held.device),
            torch.tensor([low[0], high[1]]).to(held),
            torch.tensor([1 / _PIXEL_M, -1 / _PIXEL_M]).to(held),
            torch.tensor([columns - 1.0, rows - 1.0]).to(held),
        )

    def at(self, places_m: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """z of the foremost surface where places lie; NaN beside it."""
        rows, columns = self.depth_m.shape
        px = (places_m[:, :2] - self.corner_m) * self.px_per_m
        found = F.grid_sample(
            self.depth_m[None, None], (2 * px / self.last_px - 1)[None, None], align_corners=True
        )
        column, row = px.round().long().unbind(1)
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        inside &= self.there[row.clamp(0, rows - 1), column.clamp(0, columns - 1)]
        return torch.where(inside, found[0, 0, 0], torch.nan)

    def overhang(
        self, centres_m: Float[Tensor, "N 3"], axes_m: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N"]:
        """1 where Gaussians with these longest axes reach out before another part of the head.

        Those below a chin that paint the throat from there hang before it like a beard, and from
        in front it is all the same. What stands before the surface as a whole, as glasses, does
        not count. Axes are as long as their standard deviations.
        """
        tips_m = centres_m + _TIP * axes_m, centres_m - _TIP * axes_m
        before_m = self.before_m(tips_m[0]).maximum(self.before_m(tips_m[1]))
        return ramp(before_m - self.before_m(centres_m).clamp(min=0), *_BEFORE_M)

    def before_m(self, places_m: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """How far before the foremost surface places lie, along the head's z axis at rest; -1 m
        beside it."""
        return (places_m[:, 2] - self.at(places_m)).nan_to_num(nan=-1.0)


def longest_axes_m(
    shapes: TangentBlendshapes, frame_wxyz: Float[Tensor, "N 4"]
) -> Float[Tensor, "N 3"]:
    """The longest axis of each Gaussian, as long as its standard deviation, on the head at rest.

    frame_wxyz turns the head's axes into those that rotations are in.
    """
    log_scale, longest = shapes.log_scale.max(1, keepdim=True)
    axis = torch.zeros_like(shapes.log_scale).scatter_(1, longest, log_scale.exp())
    for turn_wxyz in (F.normalize(shapes.rotation_wxyz, dim=-1), frame_wxyz):
        axis = turn_back(conjugate_quats_wxyz(turn_wxyz), axis)
    return axis


def shorten_overhanging(
    shapes: TangentBlendshapes,
    front: FrontSurface,
    rest_m: Float[Tensor, "N 3"],
    frame_wxyz: Float[Tensor, "N 4"],
    disc: Float[Tensor, "N 3"],
    shares: tuple[Float[Tensor, "N"], Float[Tensor, "N"], Float[Tensor, "N"]],
) -> None:
    """Go by a share to the width of its disc along the longest axis of what overhangs.

    rest_m: where Gaussians are on the head at rest; frame_wxyz: see `longest_axes_m`; `disc` holds
    logarithms of scales; shares: of what reaches out across the view, and along it; and of what
    closes sides by reaching along it, of which only the end that stands before the head is cut off.
    Ours, because from in front all that a chin paints of a throat, and how long a needle beside a
    cheek is, is the same, and turned heads had whiskers.
    """
    log_scale, longest = shapes.log_scale.max(1, keepdim=True)
    short = log_scale.minimum(disc[:, :2].mean(1, keepdim=True))
    axes_m = longest_axes_m(shapes, frame_wxyz)
    length_m = axes_m.norm(dim=1).clamp(min=1e-9)
    across = ramp(axes_m[:, :2].norm(dim=1) / length_m, *_ACROSS)
    goes = torch.lerp(shares[1], shares[0], across) * front.overhang(rest_m, axes_m)
    ahead_m = _TIP * axes_m * torch.where(axes_m[:, 2:] < 0, -1.0, 1.0)
    # What stands off as a whole, as the side of glasses, is no end of anything.
    own = ramp(front.before_m(rest_m), _BEFORE_M[0], 0.0)
    before = (front.before_m(rest_m + ahead_m) - _BEFORE_M[0]).clamp(min=0)
    spare = (1 - _NEEDLE * disc[:, :2].amax(1).exp() / length_m).clamp(min=0)
    cut = shares[2] * (1 - across) * own * (before / (2 * _TIP * length_m)).minimum(spare)
    shapes.position.sub_(turn_back(frame_wxyz, cut[:, None] * ahead_m))
    log_scale = log_scale.lerp(short, goes[:, None]) + (1 - cut).log()[:, None]
    shapes.log_scale.scatter_(1, longest, log_scale)
