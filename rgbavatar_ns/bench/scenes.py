"""Synthetic Gaussians and cameras to measure with; imports nothing that reads data."""

from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.training import TrainingBatch
from rgbavatar_ns.avatar.training.batches import DeviceFrames
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras

DEFAULT_COUNT = 60_000
DEFAULT_SIZE_PX = 512
_HEAD_SHARE = 0.8
"""Share of the image's height that the head takes without a dataset's camera."""


_Record = TypeVar("_Record", GaussianSet, PinholeCameras, TrainingBatch, DeviceFrames)


def on_device(record: _Record, device: torch.device) -> _Record:
    """The same dataclass with its tensors there."""
    movable = {n: v for n, v in vars(record).items() if isinstance(v, Tensor | PinholeCameras)}
    return replace(record, **{name: value.to(device) for name, value in movable.items()})


def leaf_gaussians(gaussians: GaussianSet) -> GaussianSet:
    """The same Gaussians as leaves that ask for gradients."""
    return GaussianSet(
        **{name: value.detach().requires_grad_() for name, value in vars(gaussians).items()}
    )


def ellipsoid_scene(
    count: int = DEFAULT_COUNT,
    size_px: int = DEFAULT_SIZE_PX,
    batch: int = 10,
    *,
    shared: bool = False,
    seed: int = 0,
) -> tuple[GaussianSet, PinholeCameras]:
    """The common workload: Gaussians on a head-sized ellipsoid, and one camera for all images.

    `shared` gives opacities and scales a leading dimension of 1. Everything in pixels grows with
    the image, so that the number of pairs is proportional to its pixels.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *size: int) -> Tensor:
        return low + (high - low) * torch.rand(*size, generator=generator)

    direction = torch.randn(batch, count, 3, generator=generator)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    leading = 1 if shared else batch
    # One pixel at 512 x 512 is 0.44 mm at the head's distance.
    ranges_m = ((0.5e-3, 1.3e-3), (0.3e-3, 0.8e-3), (0.1e-3, 0.25e-3))
    gaussians = GaussianSet(
        means=direction * torch.tensor([0.085, 0.115, 0.1]),
        quats_wxyz=torch.randn(batch, count, 4, generator=generator),
        scales=torch.stack([uniform(*ends, leading, count) for ends in ranges_m], -1),
        opacities=uniform(0.1, 0.95, leading, count),
        colors=uniform(0.0, 1.0, batch, count, 3),
    )
    world_to_camera = torch.eye(4)[None].clone()
    world_to_camera[0, 2, 3] = 1.0
    cameras = PinholeCameras(
        world_to_camera,
        torch.full((1, 2), 4.4 * size_px),
        torch.full((1, 2), size_px / 2),
        size_px,
        size_px,
    )
    return gaussians, cameras


def close_camera(avatar: Avatar, size_px: int) -> PinholeCameras:
    """A camera a metre in front of the head, which takes most of the image's height."""
    vertices: Float[Tensor, "V 3"] = torch.as_tensor(avatar.head.arrays.v_template).float()
    low, high = vertices.amin(0), vertices.amax(0)
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    shift = -world_to_camera[:3, :3] @ ((low + high) / 2)
    world_to_camera[:3, 3] = shift + torch.tensor([0.0, 0.0, 1.0])
    focal_px = _HEAD_SHARE * size_px / float(high[1] - low[1])
    return PinholeCameras(
        world_to_camera=world_to_camera[None],
        focal_px=torch.full((1, 2), focal_px),
        principal_point_px=torch.full((1, 2), size_px / 2),
        width=size_px,
        height=size_px,
    )
