"""A peer: the same pictures by dense torch over tiles, with autograd for the gradients.

What one writes without a kernel: every tile of pixels against every Gaussian that may touch it.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.bench.projection import (
    ImageGaussians,
    one_camera,
    one_image,
    project,
    visible_index,
)
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.kernels.constants import MAX_ALPHA, MIN_ALPHA

TILE_PX = 16


def dense_torch(gaussians: GaussianSet, cameras: PinholeCameras) -> Float[Tensor, "B H W 3"]:
    """Images over black, blended front to back without early stopping."""
    batch = max(*(len(value) for value in vars(gaussians).values()), len(cameras.focal_px))
    images = []
    for position in range(batch):
        single, camera = one_image(gaussians, position), one_camera(cameras, position)
        projected = project(single, camera, visible_index(single, camera))
        images.append(_draw(projected, camera.width, camera.height))
    return torch.stack(images)


def _draw(projected: ImageGaussians, width: int, height: int) -> Float[Tensor, "H W 3"]:
    columns, lists = _tile_lists(projected, width, height)
    tiles = [
        _draw_tile(projected, index, TILE_PX * (number % columns), TILE_PX * (number // columns))
        for number, index in enumerate(lists)
    ]
    grid = torch.stack(tiles).unflatten(0, (-1, columns))
    image = grid.unflatten(2, (TILE_PX, TILE_PX)).transpose(1, 2).flatten(2, 3).flatten(0, 1)
    return image[:height, :width]


@torch.no_grad()
def _tile_lists(
    projected: ImageGaussians, width: int, height: int
) -> tuple[int, list[Int[Tensor, "_"]]]:
    """Tiles in a row, and for each tile, row by row, its Gaussians from front to back."""
    columns, rows = -(-width // TILE_PX), -(-height // TILE_PX)
    limit = torch.tensor([columns, rows])
    half = torch.sqrt(projected.reach[:, None] * projected.variance_px2)
    first = torch.floor((projected.mean_px - half) / TILE_PX).clamp(min=0).long()
    last = torch.floor((projected.mean_px + half) / TILE_PX).long()
    size = (torch.minimum(last + 1, limit) - first).clamp(min=0)
    order = torch.argsort(projected.depth_m, stable=True)
    count = size.prod(-1)[order]
    index = torch.repeat_interleave(order, count)
    place = torch.arange(len(index)) - torch.repeat_interleave(count.cumsum(0) - count, count)
    column = first[index, 0] + place % size[index, 0]
    row = first[index, 1] + place // size[index, 0]
    tile = row * columns + column
    by_tile = torch.argsort(tile, stable=True)
    lengths = torch.bincount(tile, minlength=columns * rows).tolist()
    return columns, list(torch.split(index[by_tile], lengths))


def _draw_tile(
    projected: ImageGaussians, index: Int[Tensor, "n"], left: int, top: int
) -> Float[Tensor, "P 3"]:
    """The pixels of the tile whose first pixel is (left, top)."""
    steps = torch.arange(TILE_PX).to(projected.mean_px) + 0.5
    x, y = (left + steps).repeat(TILE_PX), (top + steps).repeat_interleave(TILE_PX)
    dx = x - projected.mean_px[index, 0, None]
    dy = y - projected.mean_px[index, 1, None]
    xx, xy, yy = projected.conic[index].unsqueeze(1).unbind(-1)
    distance = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
    alpha = projected.opacities[index, None] * torch.exp(-0.5 * distance)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp(max=MAX_ALPHA), 0.0)
    remaining = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(remaining[:1]), remaining[:-1]])
    return (alpha * before).T @ projected.colors[index]
