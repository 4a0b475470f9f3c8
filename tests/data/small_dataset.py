"""A dataset of a few small frames of noise, for tests that need files rather than a face."""

from pathlib import Path

import numpy as np
import torch

from rgbavatar_ns.data import DatasetWriter, TrackedDataset, TrackedFrame
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import PinholeCameras

WIDTH, HEIGHT = 12, 8
NUM_FRAMES, NUM_TEST = 7, 2
CAMERA_PARTS = ("world_to_camera", "focal_px", "principal_point_px")


def noise_image(index: int) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)


def odd_camera(shift: float = 0.0) -> PinholeCameras:
    """A camera whose numbers have no short decimal form."""
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None].clone()
    world_to_camera[0, :3, 3] = torch.tensor([1 / 3 + shift, -1 / 7, 2 / 3])
    return PinholeCameras(
        world_to_camera,
        torch.tensor([[100 / 3, 100 / 7]]),
        torch.tensor([[WIDTH / 2 + 1 / 9, HEIGHT / 2]]),
        WIDTH,
        HEIGHT,
    )


def frame(head: HeadModel, index: int, per_frame_camera: bool = False) -> TrackedFrame:
    theta = torch.randn(head.layout.size, generator=torch.Generator().manual_seed(index))
    camera = odd_camera(index / 17 if per_frame_camera else 0.0)
    return TrackedFrame(index, theta, camera, noise_image(index))


def small_writer(folder: Path, head: HeadModel, **more: bool) -> DatasetWriter:
    identity = torch.linspace(-1, 1, head.num_identity) / 3
    return DatasetWriter(folder, head.arrays, identity, head.layout, WIDTH, HEIGHT, **more)


def small_dataset(folder: Path, head: HeadModel, per_frame_camera: bool = False) -> TrackedDataset:
    writer = small_writer(folder, head)
    for index in range(NUM_FRAMES):
        writer.add(frame(head, index, per_frame_camera))
    return writer.finish(NUM_TEST)
