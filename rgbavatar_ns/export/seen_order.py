"""Which Gaussians are seen most, so that the first ones of a file already are a head."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.orbit import head_centre, orbit
from rgbavatar_ns.kernels import PinholeCameras, weighted_color_average

_VIEWS_DEGREES = ((0, 0), (-35, 0), (35, 0), (0, -20), (0, 20), (-70, 0), (70, 0))
"""(yaw, pitch) from the front: where films look from, and how far the page turns."""
_CELL_TEXELS = 8
"""Cells of 8 x 8 texels share their surface; with 16 x 16 the picture of a quarter of the
Gaussians has 0.5 dB less, with 4 x 4 a sixteenth of them leave cells empty."""


@dataclass(frozen=True)
class SeenOrder:
    """The Gaussians from the most to the least needed."""

    order: Int[Tensor, "N"]
    weight: Float[Tensor, "N"]
    """Blending weight summed over pixels and averaged over pictures: what each Gaussian, in its
    old place, adds."""
    cell: Int[Tensor, "N"]
    """The patch of surface that each, in its old place, belongs to; counted from 0."""


@torch.no_grad()
def seen_order(avatar: Avatar, theta: Float[Tensor, "F H"], front: PinholeCameras) -> SeenOrder:
    """Order by what each adds to pictures of these expressions from all sides that are looked from.

    front: one camera before the face. The r-th of a cell counts 1 / r of what it adds: any number
    of first Gaussians covers the whole head, and more densely what is seen more. Source: ours; by
    the weight alone the eyes, of many small ones, come last (1 to 3 dB less for a quarter).
    """
    like = avatar.identity
    yaw, pitch = torch.tensor(_VIEWS_DEGREES, dtype=torch.float32).unbind(1)
    ones = like.new_ones(1, front.height, front.width, 1)
    weight = torch.zeros(avatar.num_gaussians)
    for frame in theta.to(like).split(1):
        around = orbit(front, head_centre(avatar, frame), yaw, pitch)
        gaussians = avatar.gaussians(frame.expand(len(yaw), -1))
        seen = weighted_color_average(gaussians, around, ones)
        weight += seen.weight_sum.mean(0).cpu() / len(theta)
    row, column = (avatar.anchors.texel_row_col.cpu() // _CELL_TEXELS).unbind(1)
    _, cell = torch.unique(row * avatar.anchors.resolution + column, return_inverse=True)
    rank = _rank_within(cell, weight)
    order = torch.argsort(weight / (rank + 1), descending=True, stable=True)
    return SeenOrder(order, weight, cell)


def _rank_within(cell: Int[Tensor, "N"], weight: Float[Tensor, "N"]) -> Int[Tensor, "N"]:
    """Place within the cell by weight, from 0."""
    order = torch.argsort(weight, descending=True, stable=True)
    order = order[torch.argsort(cell[order], stable=True)]
    counts = torch.bincount(cell)
    start = torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order)) - start
    return rank
