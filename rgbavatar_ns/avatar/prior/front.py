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
    def of(cls, avatar: Avatar, field: MeshField) -> "FrontSurface":
        """Drawn from afar to near."""
        # Here, so that timing steps on a bare machine needs no OpenCV.
        import cv2

        rest_m = field.rest_m.cpu().double().numpy()
        faces = avatar.head.faces.cpu().long().numpy()
        low, high = rest_m.min(0), rest_m.max(0)
        columns, rows = (int(part / _PIXEL_M) + 2 for part in (high - low)[:2])
        px = np.stack([rest_m[:, 0] - low[0], high[1] - rest_m[:, 1]], 1) / _PIXEL_M
        corners = np.round(px[faces] * 16).astype(np.int32)
        drawn = np.full((rows, columns), np.nan, np.float32)
        forward = rest_m[faces, 2].mean(1)
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
        return ramp(self.overhang_m(centres_m, axes_m)[0], *_BEFORE_M)

    def overhang_m(
        self, centres_m: Float[Tensor, "N 3"], axes_m: Float[Tensor, "N 3"]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
        """How far a Gaussian's foremost tip stands before the surface, or how much farther than
        its centre does, and which way along its axis that tip is: 1 or -1."""
        centre, first, second = (
            (place[:, 2] - self.at(place)).nan_to_num(nan=-1.0)
            for place in (centres_m, centres_m + _TIP * axes_m, centres_m - _TIP * axes_m)
        )
        way = torch.where(first >= second, 1.0, -1.0)
        return first.maximum(second) - centre.clamp(min=0), way


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
    shares: tuple[Float[Tensor, "N"], Float[Tensor, "N"]],
) -> None:
    """Go by a share to the width of its disc along the longest axis of what overhangs.

    rest_m: where Gaussians are on the head at rest; frame_wxyz: see `longest_axes_m`; `disc` holds
    logarithms of scales; shares: of what reaches out across the view, and along it, which closes
    sides and is theirs. Ours, because from in front all that a chin paints of a throat is the
    same, and turned heads had whiskers.
    """
    log_scale, longest = shapes.log_scale.max(1, keepdim=True)
    short = log_scale.minimum(disc[:, :2].mean(1, keepdim=True))
    axes_m = longest_axes_m(shapes, frame_wxyz)
    across = axes_m[:, :2].norm(dim=1) / axes_m.norm(dim=1).clamp(min=1e-9)
    share = torch.lerp(shares[1], shares[0], ramp(across, *_ACROSS))
    goes = share * front.overhang(rest_m, axes_m)
    shapes.log_scale.scatter_(1, longest, log_scale.lerp(short, goes[:, None]))


def trim_ahead(
    shapes: TangentBlendshapes,
    front: FrontSurface,
    rest_m: Float[Tensor, "N 3"],
    frame_wxyz: Float[Tensor, "N 4"],
    disc: Float[Tensor, "N 3"],
    share: Float[Tensor, "N"],
) -> None:
    """Cut off by a share what of a Gaussian along the view stands before the head; the rest stays.

    Arguments as of `shorten_overhanging`. Ours, because sides are closed by what reaches along the
    view, and beside a cheek such a needle came out of it.
    """
    axes_m = longest_axes_m(shapes, frame_wxyz)
    length_m = axes_m.norm(dim=1).clamp(min=1e-9)
    along = ramp(axes_m[:, :2].norm(dim=1) / length_m, *_ACROSS[::-1])
    excess_m, way = front.overhang_m(rest_m, axes_m)
    before = (excess_m - _BEFORE_M[0]).clamp(min=0) / (2 * _TIP * length_m)
    spare = 1 - _NEEDLE * disc[:, :2].amax(1).exp() / length_m
    cut = share * along * before.minimum(spare.clamp(min=0))
    back_m = turn_back(frame_wxyz, -(_TIP * way * cut)[:, None] * axes_m)
    shapes.position.add_(back_m)
    longest = shapes.log_scale.argmax(1, keepdim=True)
    shapes.log_scale.scatter_add_(1, longest, (1 - cut).log()[:, None])
