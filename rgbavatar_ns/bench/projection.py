"""Projection in plain torch for counts and peers, apart from the kernels they are held against."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.kernels.constants import (
    DILATION_PX2,
    FRUSTUM_MARGIN,
    MIN_ALPHA,
    NEAR_PLANE_M,
)


@dataclass(frozen=True)
class ImageGaussians:
    """One image's Gaussians in its plane: q(d) = xx dx^2 + 2 xy dx dy + yy dy^2 with `conic`.

    `reach` is the q at which alpha falls to MIN_ALPHA, so a pixel is touched where q <= reach.
    """

    mean_px: Float[Tensor, "n 2"]
    conic: Float[Tensor, "n 3"]
    variance_px2: Float[Tensor, "n 2"]
    depth_m: Float[Tensor, "n"]
    opacities: Float[Tensor, "n"]
    colors: Float[Tensor, "n 3"]

    @property
    def reach(self) -> Float[Tensor, "n"]:
        """2 ln(opacity / MIN_ALPHA); not negative for visible Gaussians."""
        return 2 * torch.log(self.opacities / MIN_ALPHA)


@dataclass(frozen=True)
class RowSpans:
    """Runs of touched pixels: Gaussian `index` touches columns first .. last of `row`."""

    index: Int[Tensor, "s"]
    row: Int[Tensor, "s"]
    first: Int[Tensor, "s"]
    last: Int[Tensor, "s"]


def one_image(gaussians: GaussianSet, position: int) -> GaussianSet:
    """The set of one image of the batch, with a leading dimension of 1."""
    return GaussianSet(
        **{
            name: value[position : position + 1] if len(value) > 1 else value
            for name, value in vars(gaussians).items()
        }
    )


def one_camera(cameras: PinholeCameras, position: int) -> PinholeCameras:
    """The camera of one image of the batch."""
    return cameras.select([position if len(cameras.focal_px) > 1 else 0])


def visible_index(gaussians: GaussianSet, cameras: PinholeCameras) -> Int[Tensor, "n"]:
    """Which Gaussians of a single image are before the camera and opaque enough to be drawn."""
    with torch.no_grad():
        matrix = cameras.world_to_camera[0]
        depth = gaussians.means[0] @ matrix[2, :3] + matrix[2, 3]
        opaque = gaussians.opacities[0] >= MIN_ALPHA
        return torch.nonzero(opaque & (depth >= NEAR_PLANE_M))[:, 0]


def project(
    gaussians: GaussianSet, cameras: PinholeCameras, index: Int[Tensor, "n"]
) -> ImageGaussians:
    """A single image's Gaussians at `index` in its plane (EWA splatting), differentiable."""
    matrix, focal_px = cameras.world_to_camera[0], cameras.focal_px[0]
    mean = gaussians.means[0, index] @ matrix[:3, :3].T + matrix[:3, 3]
    slope, depth = mean[:, :2] / mean[:, 2:], mean[:, 2]
    size = torch.tensor([cameras.width, cameras.height]).to(mean)
    margin = FRUSTUM_MARGIN * size / 2
    low = (-cameras.principal_point_px[0] - margin) / focal_px
    high = (size - cameras.principal_point_px[0] + margin) / focal_px
    clamped = torch.minimum(torch.maximum(slope, low), high)
    # Rows of J W: d(mean_px) / d(world position).
    jacobian = matrix[:2, :3] - clamped[:, :, None] * matrix[2, :3]
    jacobian = jacobian * (focal_px / depth[:, None])[:, :, None]
    axes = jacobian @ _rotations(gaussians.quats_wxyz[0, index])
    axes = axes * gaussians.scales[0, index, None]
    covariance = axes @ axes.mT + DILATION_PX2 * torch.eye(2).to(mean)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    conic = torch.stack([yy, -xy, xx], -1) / (xx * yy - xy * xy)[:, None]
    return ImageGaussians(
        mean_px=focal_px * slope + cameras.principal_point_px[0],
        conic=conic,
        variance_px2=torch.stack([xx, yy], -1),
        depth_m=depth,
        opacities=gaussians.opacities[0, index],
        colors=gaussians.colors[0, index],
    )


def _rotations(quats_wxyz: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """v -> v + 2 w (u x v) + 2 u x (u x v) of the unit quaternion (w, u), as a matrix."""
    unit = torch.nn.functional.normalize(quats_wxyz, dim=-1)
    scalar, vector = unit[:, :1, None], unit[:, 1:]
    eye = torch.eye(3).to(unit)
    cross = torch.linalg.cross(vector[:, None].expand(-1, 3, -1), eye.expand(len(unit), -1, -1))
    cross = cross.mT  # Column j is u x e_j.
    return eye + 2 * scalar * cross + 2 * cross @ cross


def row_spans(
    projected: ImageGaussians, width: int, height: int, max_rows: int = 2_000_000
) -> list[RowSpans]:
    """The pixels with alpha >= MIN_ALPHA as runs along rows, in chunks of about `max_rows`.

    On each row the ellipse q <= reach is an interval, so nothing is tested pixel by pixel.
    """
    if len(projected.depth_m) == 0:
        return []
    half_height = torch.sqrt(projected.reach * projected.variance_px2[:, 1])
    middle = projected.mean_px[:, 1] - 0.5
    top = torch.ceil(middle - half_height).clamp(0, height).long()
    bottom = torch.floor(middle + half_height).clamp(-1, height - 1).long()
    rows = (bottom - top + 1).clamp(min=0)
    chunk = torch.cumsum(rows, 0) // max_rows
    sizes = torch.unique_consecutive(chunk, return_counts=True)[1].tolist()
    index = torch.arange(len(rows))
    return [_spans(projected, part, top, rows, width) for part in torch.split(index, sizes)]


def _spans(
    projected: ImageGaussians,
    part: Int[Tensor, "p"],
    top: Int[Tensor, "n"],
    rows: Int[Tensor, "n"],
    width: int,
) -> RowSpans:
    count = rows[part]
    index = torch.repeat_interleave(part, count)
    before = torch.repeat_interleave(torch.cumsum(count, 0) - count, count)
    row = top[index] + torch.arange(len(index)) - before
    xx, xy, yy = projected.conic[index].unbind(-1)
    dy = row + 0.5 - projected.mean_px[index, 1]
    root = (xy * dy) ** 2 - xx * (yy * dy * dy - projected.reach[index])
    half_width = torch.sqrt(root.clamp(min=0)) / xx
    middle = projected.mean_px[index, 0] - xy * dy / xx - 0.5
    first = torch.ceil(middle - half_width).clamp(0, width).long()
    last = torch.floor(middle + half_width).clamp(-1, width - 1).long()
    touched = (root >= 0) & (last >= first)
    return RowSpans(index[touched], row[touched], first[touched], last[touched])
