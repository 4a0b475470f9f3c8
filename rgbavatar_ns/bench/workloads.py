"""What is measured: avatars with theta, camera and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor, nn

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.training import TrainingBatch
from rgbavatar_ns.bench.options import AvatarOptions
from rgbavatar_ns.bench.scenes import DEFAULT_SIZE_PX, close_camera, on_device
from rgbavatar_ns.bench.timing import CPU
from rgbavatar_ns.data import TrackedDataset, load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel

_THETA_DEVIATION = 0.05


@dataclass(frozen=True)
class AvatarWorkload:
    """An avatar and a batch to draw or to train it with, on one device."""

    avatar: Avatar
    batch: TrainingBatch
    facts: dict[str, Any]
    """What it is, for the report."""


def avatar_workload(
    options: AvatarOptions,
    batch: int,
    *,
    with_images: bool = True,
    device: torch.device = CPU,
) -> AvatarWorkload:
    """The avatar that the options name, or a fresh one; driven by their dataset or at random.

    Without `with_images` the batch's pictures are empty. Raises UserError where avatar or
    dataset cannot be read or do not fit one another or the size asked for.
    """
    config = AvatarConfig(
        num_bases=20 if options.bases is None else options.bases,
        uv_resolution=256 if options.uv is None else options.uv,
    )
    dataset = None if options.data is None else _dataset(options.data, options.size)
    avatar = load_or_make(options.avatar, dataset, config)
    training = _batch(avatar, dataset, options.size or DEFAULT_SIZE_PX, batch, with_images)
    facts = {
        "avatar": "fresh" if options.avatar is None else str(options.avatar),
        "head": avatar.head.arrays.name,
        "theta": "random" if options.data is None else str(options.data),
        "gaussians": avatar.num_gaussians,
        "bases": avatar.config.num_bases,
        "uv_resolution": avatar.config.uv_resolution,
        "width_px": training.cameras.width,
        "height_px": training.cameras.height,
        "batch": batch,
        "device": device.type,
    }
    return AvatarWorkload(avatar.to(device), on_device(training, device), facts)


def parameters_of(avatar: Avatar) -> list[nn.Parameter]:
    """All that is trained."""
    return [parameter for group in avatar.parameter_groups().values() for parameter in group]


def load_or_make(path: Path | None, dataset: TrackedDataset | None, config: AvatarConfig) -> Avatar:
    """The avatar at `path`, else a fresh one of the dataset's subject or the embedded head."""
    if path is not None:
        avatar = Avatar.load(path)
        if dataset is not None:
            avatar.require_layout(dataset.layout, str(dataset.root))
        return avatar
    if dataset is not None:
        return Avatar(HeadModel(dataset.arrays), dataset.identity, config)
    head = HeadModel.embedded()
    return Avatar(head, torch.zeros(head.num_identity), config)


def _dataset(path: Path, size_px: int | None) -> TrackedDataset:
    dataset = load_dataset(path)
    if size_px is not None and (dataset.width, dataset.height) != (size_px, size_px):
        raise UserError(
            f"The pictures of {path} are {dataset.width} x {dataset.height}, not "
            f"{size_px} x {size_px}.",
            "Leave out --size, or pass another dataset.",
        )
    return dataset


def _batch(
    avatar: Avatar, dataset: TrackedDataset | None, size_px: int, count: int, with_images: bool
) -> TrainingBatch:
    generator = torch.Generator().manual_seed(0)
    if dataset is None:
        theta = _THETA_DEVIATION * torch.randn(count, avatar.layout.size, generator=generator)
        cameras = close_camera(avatar, size_px)
        shape = (count, size_px, size_px, 4) if with_images else (count, 0, 0, 4)
        images = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
        return TrainingBatch(theta, cameras, images)
    # Spread over all frames; a dataset of fewer frames gives some of them twice.
    positions = [index * len(dataset) // count for index in range(count)]
    empty = torch.zeros(count, 0, 0, 4, dtype=torch.uint8)
    images = read_images(dataset, positions) if with_images else empty
    return TrainingBatch(dataset.theta[positions], dataset.cameras.select(positions), images)


def read_images(dataset: TrackedDataset, positions: Sequence[int]) -> UInt8[Tensor, "B H W 4"]:
    """Decode these frames."""
    return torch.stack([torch.as_tensor(dataset.read_image(position)) for position in positions])
