"""The (pixel, Gaussian) pairs of an image: the unit of a rasterizer's work."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.kernels.constants import MIN_ALPHA
from rgbavatar_ns.kernels.reference import project


def one_image(
    gaussians: GaussianSet, cameras: PinholeCameras, position: int
) -> tuple[GaussianSet, PinholeCameras]:
    """What one image of the batch shows, with leading dimensions of 1."""
    values = {
        name: value[position : position + 1] if len(value) > 1 else value
        for name, value in vars(gaussians).items()
    }
    return GaussianSet(**values), one_camera(cameras, position)


def one_camera(cameras: PinholeCameras, position: int) -> PinholeCameras:
    """The camera of one image of the batch."""
    return cameras.select([position if len(cameras.focal_px) > 1 else 0])


def count_pairs(gaussians: GaussianSet, cameras: PinholeCameras) -> int:
    """Pairs with alpha >= 1/255 over all images of the batch, counted in float64.

    Pairs behind an opaque surface count too, although a rasterizer may stop before them. Cameras
    and attributes have a leading dimension of B or 1.
    """
    exact = {"device": "cpu", "dtype": torch.float64}
    gaussians = GaussianSet(**{n: value.to(**exact) for n, value in vars(gaussians).items()})
    shared = {n: v.to(**exact) for n, v in vars(cameras).items() if isinstance(v, Tensor)}
    cameras = replace(cameras, **shared)
    batch = max(len(cameras.focal_px), *(len(value) for value in vars(gaussians).values()))
    images = (one_image(gaussians, cameras, position) for position in range(batch))
    return sum(len(pixel_pairs(*image)[0]) for image in images)


@torch.no_grad()
def pixel_pairs(
    gaussians: GaussianSet, cameras: PinholeCameras
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Gaussian and pixel (row-major) of every pair with alpha >= 1/255 of a single image.

    On each row the ellipse q(d) <= 2 ln(opacity / MIN_ALPHA) is an interval, so nothing is tested
    pixel by pixel.
    """
    projected = project(gaussians, cameras)
    visible = torch.nonzero(projected.visible[0])[:, 0]
    mean_px, covariance = projected.mean_px[0, visible], projected.covariance_px2[0, visible]
    reach = 2 * torch.log(projected.opacities[0, visible] / MIN_ALPHA)
    half_height = torch.sqrt(reach * covariance[:, 1, 1])
    index, row = _pixels_within(mean_px[:, 1], half_height, cameras.height)
    dy = row + 0.5 - mean_px[index, 1]
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    # Of q, dy^2 / yy is spent at the row's best x, which is xy / yy dy off the mean.
    left = (reach[index] - dy * dy / yy[index]).clamp(min=0)
    half_width = torch.sqrt(left * (xx - xy * xy / yy)[index])
    centre = mean_px[index, 0] + (xy / yy)[index] * dy
    run, column = _pixels_within(centre, half_width, cameras.width)
    return visible[index[run]], row[run] * cameras.width + column


def _pixels_within(
    middle: Float[Tensor, "n"], half: Float[Tensor, "n"], size: int
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Interval and pixel of each of `size` pixels whose centre lies in an interval, in order."""
    first = torch.ceil(middle - half - 0.5).clamp(0, size).long()
    last = torch.floor(middle + half - 0.5).clamp(-1, size - 1).long()
    count = (last - first + 1).clamp(min=0)
    interval = torch.repeat_interleave(torch.arange(len(count)), count)
    before = torch.cumsum(count, 0) - count
    return interval, first[interval] + torch.arange(len(interval)) - before[interval]
