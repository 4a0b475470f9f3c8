"""The specification of the rasterizer, in plain torch, for any float type.

One Gaussian with mean m, rotation R(q) and standard deviations s is drawn by a camera with
rotation W, translation t, focal lengths f and principal point c:

    (x, y, z) = W m + t                            camera space, z forward
    mean_px   = (fx x / z + cx, fy y / z + cy) + screen_offset
    J         = [[fx / z, 0, -fx u / z],           u = x / z, v = y / z, both clamped to the image
                 [0, fy / z, -fy v / z]]           widened by FRUSTUM_MARGIN (EWA splatting)
    cov_px    = J W R diag(s^2) R^T W^T J^T + DILATION_PX2
    alpha     = min(MAX_ALPHA, opacity exp(-d^T cov_px^-1 d / 2)),    d = pixel centre - mean_px

Alphas below MIN_ALPHA are dropped. Gaussians are blended front to back by z (ties by index):
weight w_i = alpha_i T_i with T_i = prod_{j<i} (1 - alpha_j). A BLOCK_PX x BLOCK_PX block of
pixels, counted from the image's first pixel, takes a Gaussian only while one of its pixels has
T_i >= MIN_TRANSMITTANCE; deciding for a block instead of a pixel is ours, because it is what fast
backends can afford and it is nearer to the full sum.

Gaussians that are not finite, have no orientation (MIN_QUAT_NORM) or overflow when projected
contribute nothing and get a gradient of zero. The clamp of u and v has no gradient outside.
`screen_offset`, 0 unless it is given, moves the drawn mean only: u, v and z are those of m.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rgbavatar_ns.kernels.constants import (
    BLOCK_PX,
    DILATION_PX2,
    FRUSTUM_MARGIN,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_QUAT_NORM,
    MIN_TRANSMITTANCE,
    NEAR_PLANE_M,
)
from rgbavatar_ns.kernels.types import GaussianSet, PinholeCameras, RenderedBatch, WeightedColors

_TILE_PX = 8 * BLOCK_PX


@dataclass(frozen=True)
class BlendingRules:
    """Departures from the rule above that tests need.

    `smooth_cutoff` replaces the step at MIN_ALPHA by a sigmoid, so that finite differences
    exist; `block_stopping=False` sums every Gaussian.
    """

    smooth_cutoff: bool = False
    block_stopping: bool = True


@dataclass(frozen=True)
class ProjectedGaussians:
    """Gaussians in the image plane; `visible` marks those that may be drawn."""

    mean_px: Float[Tensor, "B N 2"]
    covariance_px2: Float[Tensor, "B N 2 2"]
    depth_m: Float[Tensor, "B N"]
    opacities: Float[Tensor, "B N"]
    colors: Float[Tensor, "B N 3"]
    visible: Bool[Tensor, "B N"]


@dataclass(frozen=True)
class _Tile:
    """One image's pixels [top:bottom, left:right] and the weights of what is seen there."""

    image_index: int
    rows: slice
    columns: slice
    gaussian_index: Int[Tensor, " n"]
    weights: Float[Tensor, "n P"]
    transmittance: Float[Tensor, " P"]


def rotation_matrices(quats_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions of any length but zero."""
    w, x, y, z = (quats_wxyz / quats_wxyz.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    )
    return torch.stack(rows, -2)


def _frustum_limits(cameras: PinholeCameras) -> tuple[Tensor, Tensor]:
    """Smallest and largest (x / z, y / z) [C, 1, 2] the Jacobian is evaluated at."""
    size = torch.tensor([cameras.width, cameras.height]).to(cameras.focal_px)
    margin = FRUSTUM_MARGIN * 0.5 * size / cameras.focal_px
    low = -cameras.principal_point_px / cameras.focal_px - margin
    high = (size - cameras.principal_point_px) / cameras.focal_px + margin
    return low[:, None], high[:, None]


def _project_finite(
    means: Tensor, quats_wxyz: Tensor, scales: Tensor, cameras: PinholeCameras
) -> tuple[Tensor, Tensor, Tensor]:
    """Image means, image covariances and camera-space z; assumes z > 0."""
    rotation = cameras.world_to_camera[:, None, :3, :3]
    translation = cameras.world_to_camera[:, None, :3, 3]
    mean_camera = (rotation @ means[..., None])[..., 0] + translation
    x_y, z = mean_camera[..., :2], mean_camera[..., 2]
    focal_px = cameras.focal_px[:, None]
    slope = x_y / z[..., None]
    mean_px = focal_px * slope + cameras.principal_point_px[:, None]
    low, high = _frustum_limits(cameras)
    clamped = torch.minimum(torch.maximum(slope, low), high)
    factor = rotation @ rotation_matrices(quats_wxyz) * scales[..., None, :]
    image_factor = factor[..., :2, :] - clamped[..., None] * factor[..., 2:, :]
    image_factor = image_factor * (focal_px / z[..., None])[..., None]
    dilation = DILATION_PX2 * torch.eye(2).to(means)
    return mean_px, image_factor @ image_factor.transpose(-1, -2) + dilation, z


@torch.no_grad()
def _visible(
    gaussians: GaussianSet, cameras: PinholeCameras, screen_offset: Tensor | None
) -> Bool[Tensor, "B N"]:
    mean_px, covariance, z = _project_finite(
        gaussians.means, gaussians.quats_wxyz, gaussians.scales, cameras
    )
    if screen_offset is not None:
        mean_px = mean_px + screen_offset
    determinant = covariance[..., 0, 0] * covariance[..., 1, 1] - covariance[..., 0, 1] ** 2
    finite = torch.isfinite(mean_px).all(-1) & torch.isfinite(determinant) & (determinant > 0)
    finite = finite & torch.isfinite(gaussians.colors).all(-1) & torch.isfinite(gaussians.opacities)
    length = gaussians.quats_wxyz.norm(dim=-1)
    oriented = (length >= MIN_QUAT_NORM) & torch.isfinite(length)
    return finite & oriented & (z >= NEAR_PLANE_M) & (gaussians.opacities >= MIN_ALPHA)


def project(
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    screen_offset: Float[Tensor, "B N 2"] | None = None,
) -> ProjectedGaussians:
    """Gaussians as the cameras see them; those that are not visible hold harmless numbers."""
    visible = _visible(gaussians, cameras, screen_offset)

    def keep(values: Tensor, otherwise: Tensor) -> Tensor:
        mask = visible.reshape(*visible.shape, *[1] * (values.ndim - 2))
        return torch.where(mask, values, otherwise.to(values))

    rotation = cameras.world_to_camera[:, None, :3, :3].transpose(-1, -2)
    ahead = torch.tensor([0.0, 0.0, 1.0]).to(gaussians.means)
    safe_mean = (rotation @ (ahead - cameras.world_to_camera[:, None, :3, 3])[..., None])[..., 0]
    mean_px, covariance, z = _project_finite(
        keep(gaussians.means, safe_mean),
        keep(gaussians.quats_wxyz, torch.tensor([1.0, 0.0, 0.0, 0.0])),
        keep(gaussians.scales, torch.tensor(0.0)),
        cameras,
    )
    if screen_offset is not None:
        mean_px = mean_px + keep(screen_offset, torch.tensor(0.0))
    opacities = keep(gaussians.opacities, torch.tensor(0.0))
    colors = keep(gaussians.colors, torch.tensor(0.0))
    return ProjectedGaussians(mean_px, covariance, z, opacities, colors, visible)


def _pixel_centres(rows: slice, columns: slice, like: Tensor) -> Float[Tensor, "P 2"]:
    y, x = torch.meshgrid(
        torch.arange(rows.start, rows.stop),
        torch.arange(columns.start, columns.stop),
        indexing="ij",
    )
    return torch.stack([x, y], -1).reshape(-1, 2).to(like) + 0.5


def _alphas(
    projected: ProjectedGaussians,
    image_index: int,
    gaussian_index: Tensor,
    pixels: Tensor,
    rules: BlendingRules,
) -> Float[Tensor, "n P"]:
    offset = pixels - projected.mean_px[image_index, gaussian_index, None]
    conic = torch.linalg.inv(projected.covariance_px2[image_index, gaussian_index])
    distance = ((offset @ conic) * offset).sum(-1)
    alpha = projected.opacities[image_index, gaussian_index, None] * torch.exp(-0.5 * distance)
    capped = alpha.clamp(max=MAX_ALPHA)
    if rules.smooth_cutoff:
        return capped * torch.sigmoid(8 * (alpha / MIN_ALPHA - 1))
    return torch.where(alpha >= MIN_ALPHA, capped, torch.zeros_like(capped))


def _still_open(transmittance: Tensor, rows: slice, columns: slice) -> Bool[Tensor, "n P"]:
    """Whether the pixel's block takes the Gaussian, given T before each Gaussian."""
    height, width = rows.stop - rows.start, columns.stop - columns.start
    y, x = torch.arange(height) // BLOCK_PX, torch.arange(width) // BLOCK_PX
    block = (y[:, None] * (math.ceil(width / BLOCK_PX)) + x).reshape(-1)
    block = block.to(transmittance.device)
    block = block.expand_as(transmittance)
    count = int(math.ceil(height / BLOCK_PX) * math.ceil(width / BLOCK_PX))
    largest = transmittance.new_zeros(transmittance.shape[0], count)
    largest = largest.scatter_reduce(1, block, transmittance, "amax")
    return (largest >= MIN_TRANSMITTANCE).gather(1, block)


def _tile(
    projected: ProjectedGaussians,
    image_index: int,
    rows: slice,
    columns: slice,
    gaussian_index: Tensor,
    rules: BlendingRules,
) -> _Tile:
    pixels = _pixel_centres(rows, columns, projected.mean_px)
    alpha = _alphas(projected, image_index, gaussian_index, pixels, rules)
    ones = alpha.new_ones(1, alpha.shape[1])
    before = torch.cat([ones, (1 - alpha).cumprod(0)])[:-1]
    if rules.block_stopping:
        alpha = torch.where(_still_open(before.detach(), rows, columns), alpha, 0.0)
    after = torch.cat([ones, (1 - alpha).cumprod(0)])
    return _Tile(image_index, rows, columns, gaussian_index, alpha * after[:-1], after[-1])


def _tiles(
    projected: ProjectedGaussians, cameras: PinholeCameras, rules: BlendingRules
) -> Iterator[_Tile]:
    """Tiles of every image, image by image and row by row."""
    with torch.no_grad():
        variance = projected.covariance_px2.diagonal(dim1=-2, dim2=-1)
        reach = 2 * torch.log(projected.opacities.clamp(min=MIN_ALPHA) / MIN_ALPHA)
        half_size = torch.sqrt(reach[..., None] * variance)
        low, high = projected.mean_px - half_size, projected.mean_px + half_size
    for image_index in range(projected.mean_px.shape[0]):
        order = torch.argsort(projected.depth_m[image_index], stable=True)
        order = order[projected.visible[image_index, order]]
        for top in range(0, cameras.height, _TILE_PX):
            rows = slice(top, min(top + _TILE_PX, cameras.height))
            for left in range(0, cameras.width, _TILE_PX):
                columns = slice(left, min(left + _TILE_PX, cameras.width))
                index = order
                if not rules.smooth_cutoff:
                    first, last = low[image_index, order], high[image_index, order]
                    inside = (last[:, 0] >= left) & (first[:, 0] <= columns.stop)
                    inside = inside & (last[:, 1] >= top) & (first[:, 1] <= rows.stop)
                    index = order[inside]
                yield _tile(projected, image_index, rows, columns, index, rules)


def _assemble(tiles: list[Tensor], batch: int, cameras: PinholeCameras) -> Float[Tensor, "B H W c"]:
    """Images from the tiles' [P, c] values in the order of `_tiles`."""
    per_row = math.ceil(cameras.width / _TILE_PX)
    strips = []
    for start in range(0, len(tiles), per_row):
        row = tiles[start : start + per_row]
        height = row[0].shape[0] // min(_TILE_PX, cameras.width)
        strips.append(torch.cat([t.reshape(height, -1, t.shape[-1]) for t in row], 1))
    return torch.cat(strips).reshape(batch, cameras.height, cameras.width, -1)


def rasterize_reference(
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    background: Float[Tensor, "#B 3"],
    *,
    with_depth: bool = False,
    with_visibility: bool = False,
    screen_offset: Float[Tensor, "B N 2"] | None = None,
    rules: BlendingRules | None = None,
) -> RenderedBatch:
    """Images by the rule at the top of this file; differentiable by autograd.

    Every leading dimension is B or 1 and at least one is B. Memory grows with the Gaussians
    that touch a tile times its 1024 pixels: meant for small scenes.
    """
    rules = rules or BlendingRules()
    projected = project(gaussians, cameras, screen_offset)
    batch = max(projected.mean_px.shape[0], background.shape[0])
    projected = _expand(projected, batch)
    background = background.expand(batch, 3)
    images, alphas, depths = [], [], []
    visibility = projected.depth_m.new_zeros(projected.depth_m.shape)
    for tile in _tiles(projected, cameras, rules):
        colors = projected.colors[tile.image_index, tile.gaussian_index]
        rest = tile.transmittance[:, None]
        images.append(tile.weights.T @ colors + rest * background[tile.image_index])
        alphas.append(1 - rest)
        if with_depth:
            depth = projected.depth_m[tile.image_index, tile.gaussian_index, None]
            depths.append(_expected_depth(tile.weights.detach(), depth.detach()))
        if with_visibility:
            _raise_to(visibility, tile)
    return RenderedBatch(
        _assemble(images, batch, cameras),
        _assemble(alphas, batch, cameras),
        _assemble(depths, batch, cameras) if with_depth else None,
        visibility if with_visibility else None,
    )


def weighted_color_average_reference(
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    images: Float[Tensor, "#B H W C"],
) -> WeightedColors:
    """Sums of w I and w and largest w per Gaussian and image, without gradient."""
    with torch.no_grad():
        projected = project(gaussians, cameras)
        batch = max(projected.mean_px.shape[0], images.shape[0])
        projected = _expand(projected, batch)
        images = images.expand(batch, -1, -1, -1)
        weighted_sum = images.new_zeros(*projected.depth_m.shape, images.shape[-1])
        weight_sum, max_weight = (torch.zeros_like(projected.depth_m) for _ in range(2))
        for tile in _tiles(projected, cameras, BlendingRules()):
            pixels = images[tile.image_index, tile.rows, tile.columns].flatten(0, 1)
            weighted_sum[tile.image_index, tile.gaussian_index] += tile.weights @ pixels
            weight_sum[tile.image_index, tile.gaussian_index] += tile.weights.sum(1)
            _raise_to(max_weight, tile)
        return WeightedColors(weighted_sum, weight_sum, max_weight)


def _expand(projected: ProjectedGaussians, batch: int) -> ProjectedGaussians:
    fields = {
        name: value.expand(batch, *value.shape[1:]) for name, value in vars(projected).items()
    }
    return ProjectedGaussians(**fields)


def _expected_depth(weights: Tensor, depth_m: Tensor) -> Float[Tensor, "P 1"]:
    total = weights.sum(0)[:, None]
    return torch.where(total > 0, (weights.T @ depth_m) / total.clamp(min=1e-30), 0.0)


def _raise_to(largest: Float[Tensor, "B N"], tile: _Tile) -> None:
    """Raise `largest` to the tile's weights, in place."""
    index = (tile.image_index, tile.gaussian_index)
    if tile.gaussian_index.numel():
        largest[index] = torch.maximum(largest[index], tile.weights.detach().amax(1))
