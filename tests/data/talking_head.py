"""A small clip of the embedded head, painted triangle by triangle, whose truth is known."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from rgbavatar_ns.data import DatasetWriter, TrackedDataset, TrackedFrame
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import PinholeCameras

SIZE, NUM_FRAMES, NUM_TEST = 96, 36, 4
FOCAL_PX, DISTANCE_M, HAIR_PX = 210.0, 0.9, 2


def camera() -> PinholeCameras:
    """In front of the head, a little to its left and above, looking at it."""
    eye, target = np.array([0.06, 0.02, DISTANCE_M]), np.array([0.0, -0.01, 0.0])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye
    return PinholeCameras(
        torch.from_numpy(matrix).float()[None],
        torch.full((1, 2), FOCAL_PX),
        torch.full((1, 2), SIZE / 2),
        SIZE,
        SIZE,
    )


def performance(head: HeadModel) -> torch.Tensor:
    """Starts and stops: turns, nods, sways and speech, at rest in between."""
    generator = np.random.default_rng(5)
    moving = generator.uniform(size=(NUM_FRAMES, 1)) < 0.5
    speed = generator.normal(0, [0.05, 0.12, 0.03, 0.006, 0.004], (NUM_FRAMES, 5)) * moving
    pose = np.zeros((NUM_FRAMES, 5))
    for frame in range(1, NUM_FRAMES):
        # Drawn back to the middle only while it moves, so that rest is rest.
        pose[frame] = pose[frame - 1] * np.where(moving[frame], 0.9, 1) + speed[frame]
    values = torch.from_numpy(pose).float()
    jaw = values[:, :1].abs().clamp(max=0.3)
    zero = torch.zeros(NUM_FRAMES, 1)
    return head.layout.join(
        {
            "neck": values[:, :3],
            "jaw": torch.cat([jaw, zero, zero], 1),
            "translation": torch.cat([values[:, 3:], zero], 1),
        }
    )


def painted(vertices: np.ndarray, faces: np.ndarray, view: PinholeCameras) -> np.ndarray:
    """RGBA of the mesh, far triangles first, with a rim of hair."""
    matrix = view.world_to_camera[0].double().numpy()
    in_camera = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = in_camera[:, :2] / in_camera[:, 2:] * FOCAL_PX + SIZE / 2
    corners = np.round((pixels - 0.5) * 16).astype(np.int32)[faces]
    shade = (40 + (faces[:, 0] * 37) % 180).tolist()
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    mask = np.zeros((SIZE, SIZE), np.uint8)
    for i in np.argsort(-in_camera[faces, 2].mean(1)):
        cv2.fillConvexPoly(image, corners[i], (shade[i],) * 3, cv2.LINE_8, 4)
        cv2.fillConvexPoly(mask, corners[i], 255, cv2.LINE_8, 4)
    above = mask.copy()
    above[SIZE // 2 :] = 0
    hair = cv2.dilate(above, np.ones((2 * HAIR_PX + 1,) * 2, np.uint8))
    return np.dstack([image, np.maximum(mask, hair)])


def talking_head(folder: Path) -> TrackedDataset:
    """Write the clip."""
    head = HeadModel.embedded()
    identity = torch.zeros(head.num_identity)
    theta, view = performance(head), camera()
    vertices = head(theta, identity).double().numpy()
    writer = DatasetWriter(folder, head.arrays, identity, head.layout, SIZE, SIZE)
    for index in range(NUM_FRAMES):
        image = painted(vertices[index], head.arrays.faces, view)
        writer.add(TrackedFrame(index, theta[index], view, image))
    return writer.finish(NUM_TEST)


def with_images(
    dataset: TrackedDataset, folder: Path, change: Callable[[np.ndarray], np.ndarray]
) -> TrackedDataset:
    """A copy whose images, uint8 [H, W, 4], are changed."""
    writer = DatasetWriter(
        folder, dataset.arrays, dataset.identity, dataset.layout, dataset.width, dataset.height
    )
    for position, index in enumerate(dataset.frame_index):
        image = np.ascontiguousarray(change(dataset.read_image(position)))
        view = dataset.cameras.select([position])
        writer.add(TrackedFrame(index, dataset.theta[position], view, image))
    return writer.finish(len(dataset.test))


def with_cameras(dataset: TrackedDataset, **changes: torch.Tensor) -> TrackedDataset:
    return replace(dataset, cameras=replace(dataset.cameras, **changes))


def selected(dataset: TrackedDataset, positions: list[int]) -> TrackedDataset:
    return replace(
        dataset,
        theta=dataset.theta[positions],
        cameras=dataset.cameras.select(positions),
        image_paths=[dataset.image_paths[i] for i in positions],
        frame_index=tuple(range(len(positions))),
        test=(),
    )


def offset_by(dataset: TrackedDataset, frames: int) -> TrackedDataset:
    """Image i beside the parameters of frame i + frames."""
    kept = [i for i in range(len(dataset)) if 0 <= i + frames < len(dataset)]
    return replace(selected(dataset, kept), theta=dataset.theta[[i + frames for i in kept]])
