"""A dataset of a few small frames: the embedded head's vertices as coloured dots."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from rgbavatar_ns.data import DatasetWriter, TrackedDataset, TrackedFrame
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import PinholeCameras

SIZE = 32
NUM_FRAMES = 14
NUM_TEST = 3


def tiny_dataset(
    folder: Path,
    size: int = SIZE,
    frames: int = NUM_FRAMES,
    test: int = NUM_TEST,
    fewer_expressions: int = 0,
) -> TrackedDataset:
    """Write a dataset to `folder`; the head turns, opens its jaw and moves its first expression."""
    head = _head(fewer_expressions)
    identity = torch.zeros(head.num_identity)
    camera = _front_camera(head, identity, size)
    writer = DatasetWriter(folder, head.arrays, identity, head.layout, size, size, overwrite=True)
    for index in range(frames):
        phase = 2 * math.pi * index / frames
        expression = torch.zeros(len(head.arrays.expression_names))
        expression[0] = 0.5
        theta = head.layout.join(
            {
                "expression": expression,
                "rotation": torch.tensor([0.0, 0.5 * math.sin(phase), 0.0]),
                "jaw": torch.tensor([0.1 * (1 + math.cos(phase)), 0.0, 0.0]),
            }
        )
        image = _dots(head, identity, theta, camera, index)
        writer.add(TrackedFrame(index, theta, camera, image))
    return writer.finish(test)


def _head(fewer_expressions: int) -> HeadModel:
    arrays = HeadModel.embedded().arrays
    kept = len(arrays.expression_names) - fewer_expressions
    return HeadModel(
        dataclasses.replace(
            arrays,
            shapedirs=arrays.shapedirs[..., : arrays.num_identity + kept],
            expression_names=arrays.expression_names[:kept],
        )
    )


def _front_camera(head: HeadModel, identity: torch.Tensor, size: int) -> PinholeCameras:
    vertices = head(torch.zeros(head.layout.size), identity)
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None]
    world_to_camera[0, :3, 3] = torch.tensor([0.0, 0.0, 1.0]) - middle * torch.tensor(
        [1.0, -1.0, -1.0]
    )
    return PinholeCameras(
        world_to_camera=world_to_camera,
        focal_px=torch.full((1, 2), 2.2 * size),
        principal_point_px=torch.full((1, 2), size / 2),
        width=size,
        height=size,
    )


def _dots(
    head: HeadModel,
    identity: torch.Tensor,
    theta: torch.Tensor,
    camera: PinholeCameras,
    index: int,
) -> npt.NDArray[np.uint8]:
    """Each pixel that a vertex falls into gets the nearest one's colour, from its rest place."""
    matrix = camera.world_to_camera[0]
    seen = head(theta, identity) @ matrix[:3, :3].T + matrix[:3, 3]
    pixel = seen[:, :2] / seen[:, 2:] * camera.focal_px[0] + camera.principal_point_px[0]
    rest = head(torch.zeros_like(theta), identity)
    shade = (rest - rest.amin(0)) / (rest.amax(0) - rest.amin(0))
    image = np.zeros((camera.height, camera.width, 4), dtype=np.uint8)
    # Of what is written to one place the last stays: the nearest.
    nearer = torch.argsort(seen[:, 2], descending=True)
    column, row = pixel[nearer].floor().long().T
    within = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    color = (shade[nearer] * 200 + 40).to(torch.uint8)
    opaque = torch.full((len(color), 1), 255, dtype=torch.uint8)
    color_rgba = torch.cat([color, opaque], 1)[within].numpy()
    image[row[within].numpy(), column[within].numpy()] = color_rgba
    return image
