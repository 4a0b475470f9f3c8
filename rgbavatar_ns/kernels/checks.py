"""Checks of tensors before compiled code reads them: it reads what it is promised."""

import math

import torch
from torch import Tensor

from rgbavatar_ns.kernels.constants import MAX_AVERAGE_CHANNELS
from rgbavatar_ns.kernels.types import SIGHT_SUMS, AdamParameter, FirstSight, PinholeCameras


def holds_nonfinite(tensor: Tensor) -> bool:
    """Whether a tensor in main memory holds NaN or infinity; not asked of a GPU, which it stops."""
    if tensor.device.type != "cpu":
        return False
    # Only finite numbers have a finite sum, which is one operation where the exact test is five.
    return not math.isfinite(tensor.detach().sum().item()) and not bool(tensor.isfinite().all())


def check_vertices(triangle_vertices: Tensor, vertices: Tensor) -> None:
    """Raise ValueError where triangles name vertices that [B, V, 3] lacks; not asked of a GPU."""
    if triangle_vertices.device.type != "cpu" or not len(triangle_vertices):
        return
    needed = int(triangle_vertices.max()) + 1
    if vertices.shape[1] < needed:
        raise ValueError(
            f"There are {vertices.shape[1]} vertices, and the Gaussians' triangles name {needed}. "
            "Pass those of the mesh that the Gaussians were made for."
        )


def check_moments(parameter: AdamParameter) -> None:
    """Raise ValueError unless a parameter and its moments can be updated where they lie."""
    for name in ("value", "first_moment", "second_moment"):
        tensor: Tensor = getattr(parameter, name)
        fits = tensor.shape == parameter.value.shape and tensor.dtype == torch.float32
        if not (fits and tensor.is_contiguous()):
            raise ValueError(
                f"{name} is {tensor.dtype} {list(tensor.shape)} of strides "
                f"{list(tensor.stride())}. It is updated where it lies: pass contiguous "
                f"torch.float32 {list(parameter.value.shape)}."
            )


def check_average_images(images: Tensor, weights: Tensor, cameras: PinholeCameras) -> None:
    """Raise ValueError unless the images can be averaged over the sets of `weights` [B, K]."""
    _check_size(images, weights.dtype, cameras)
    if len(images) not in (1, len(weights)):
        raise ValueError(f"There are {len(images)} images for {len(weights)} sets.")
    if not 1 <= images.shape[-1] <= MAX_AVERAGE_CHANNELS:
        raise ValueError(
            f"images have {images.shape[-1]} channels. Pass 1 to {MAX_AVERAGE_CHANNELS}."
        )


def check_target_images(images_rgba: Tensor, batch: int, cameras: PinholeCameras) -> None:
    """Raise ValueError unless there is one RGBA image of 8 bits for each set."""
    _check_size(images_rgba, torch.uint8, cameras)
    if len(images_rgba) != batch or images_rgba.shape[-1] != 4:
        raise ValueError(
            f"images are {list(images_rgba.shape)}. Pass one RGBA image for each of the "
            f"{batch} sets."
        )


def check_sight(sight: FirstSight, count: int, like: Tensor) -> None:
    """Raise ValueError unless first sights of `count` Gaussians can be summed beside `like`."""
    wanted = {"known": (torch.bool, (count,)), "sums": (torch.int64, (count, SIGHT_SUMS))}
    for name, (dtype, shape) in wanted.items():
        tensor: Tensor = getattr(sight, name)
        fits = tensor.dtype == dtype and tuple(tensor.shape) == shape and tensor.is_contiguous()
        if not fits or tensor.device != like.device:
            found = f"{tensor.dtype} {list(tensor.shape)} on {tensor.device}"
            raise ValueError(
                f"{name} is {found}. Pass contiguous {dtype} {list(shape)} on {like.device}."
            )
    if sight.num_images < 0:
        raise ValueError(f"{sight.num_images} images cannot count. Pass 0 or more.")


def _check_size(images: Tensor, dtype: torch.dtype, cameras: PinholeCameras) -> None:
    size = (cameras.height, cameras.width)
    if images.dtype != dtype or images.ndim != 4 or tuple(images.shape[1:3]) != size:
        raise ValueError(
            f"images are {images.dtype} {list(images.shape)}. Pass {dtype} "
            f"[B, {size[0]}, {size[1]}, C]: the cameras' size."
        )
