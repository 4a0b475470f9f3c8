"""Frames of a dataset made small, with the head as the dataset says it should appear in them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from rgbavatar_ns.data.check.silhouette import (
    SilhouetteOverlap,
    down_to_the_neck,
    silhouette_overlap,
)
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.drawing.compositing import all_filmed, unfilmed_pixels
from rgbavatar_ns.drawing.wireframe import mesh_silhouette
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.joints import ROOT

SMALL_PX = 96
"""Longer side of the images that silhouettes are compared in."""
_CHUNK = 16
_NEAREST_M = 1e-3
_OPAQUE, _MATTED_SHARE = 0.5, 0.98
_OF_FRAMES = (
    *("alpha", "gray", "filmed", "vertices"),
    *("world_to_camera", "focal_px", "principal_point_px"),
)


@dataclass(frozen=True)
class Sample:
    """F small frames: what the images show, and where theta and the cameras put the head.

    The mesh is the part of the head that follows the neck more than the root, without shoulders.
    """

    positions: tuple[int, ...]
    alpha: Float[np.ndarray, "F h w"]
    gray: Float[np.ndarray, "F h w"]
    """Luminance times alpha, in [0, 1]."""
    filmed: Bool[np.ndarray, "F h w"]
    """Where a frame shows nothing that nobody filmed."""
    vertices: Float[np.ndarray, "F V 3"]
    """In the head's world, metres."""
    faces: Int[np.ndarray, "T 3"]
    world_to_camera: Float[np.ndarray, "F 4 4"]
    focal_px: Float[np.ndarray, "F 2"]
    principal_point_px: Float[np.ndarray, "F 2"]
    rest: Float[np.ndarray, "V 3"]
    """The same vertices at rest."""
    scale: float
    """Size of the small frames by that of the images."""

    @property
    def has_mattes(self) -> bool:
        """Whether the images are cut out at all: opaque ones have no silhouette."""
        return bool((self.alpha > _OPAQUE)[self.filmed].mean() < _MATTED_SHARE)

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, places: Sequence[int]) -> "Sample":
        """Some of the frames, by their place in this sample."""
        chosen = list(places)
        arrays = {name: getattr(self, name)[chosen] for name in _OF_FRAMES}
        return replace(self, positions=tuple(self.positions[place] for place in chosen), **arrays)


@dataclass(frozen=True)
class Projection:
    """V vertices in F small frames, in pixels; those behind the camera are not seen."""

    points_px: Float[np.ndarray, "F V 2"]
    seen: Bool[np.ndarray, "F V"]


def spread(count: int, wanted: int) -> Int[np.ndarray, "n"]:
    """At most `wanted` places of `count`, evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(np.int64))


def take_sample(
    dataset: TrackedDataset,
    positions: Sequence[int],
    progress: Callable[[int, int], None] | None = None,
) -> Sample:
    """Decode these frames and pose the head; raises UserError naming an image that is damaged."""
    scale = SMALL_PX / max(dataset.width, dataset.height)
    size = (max(1, round(dataset.width * scale)), max(1, round(dataset.height * scale)))
    alphas, grays, unfilmed = [], [], []
    for done, position in enumerate(positions):
        image = dataset.read_image(position)
        marked = unfilmed_pixels(image).astype(np.float32)
        unfilmed.append(cv2.resize(marked, size, interpolation=cv2.INTER_AREA))
        image = all_filmed(image)  # a mark that is blended is a colour
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        alphas.append(small[..., 3])
        grays.append(small[..., :3].mean(-1) * small[..., 3])
        if progress is not None:
            progress(done + 1, len(positions))
    vertices, faces, rest = _posed(dataset, positions)
    chosen = dataset.cameras.select(positions)
    by_axis = np.array(size) / np.array([dataset.width, dataset.height])
    return Sample(
        tuple(positions),
        np.stack(alphas),
        np.stack(grays),
        np.stack(unfilmed) == 0,
        vertices,
        faces,
        chosen.world_to_camera.double().numpy(),
        chosen.focal_px.double().numpy() * by_axis,
        chosen.principal_point_px.double().numpy() * by_axis,
        rest,
        scale,
    )


def _posed(
    dataset: TrackedDataset, positions: Sequence[int]
) -> tuple[Float[np.ndarray, "F V 3"], Int[np.ndarray, "T 3"], Float[np.ndarray, "V 3"]]:
    arrays = dataset.arrays
    head = HeadModel(arrays)
    with_head = arrays.skinning_weights[:, ROOT] < 0.5
    faces = arrays.faces[with_head[arrays.faces].all(1)]
    kept = np.unique(faces)
    theta = dataset.theta[list(positions)]
    with torch.no_grad():
        vertices = [
            head(theta[start : start + _CHUNK], dataset.identity)[:, kept].numpy()
            for start in range(0, len(theta), _CHUNK)
        ]
    numbered = np.searchsorted(kept, faces).astype(np.int64)
    return np.concatenate(vertices), numbered, arrays.v_template[kept]


def project(
    vertices: Float[np.ndarray, "F V 3"],
    world_to_camera: Float[np.ndarray, "F 4 4"],
    focal_px: Float[np.ndarray, "F 2"],
    principal_point_px: Float[np.ndarray, "F 2"],
) -> Projection:
    """Vertices in pixels (OpenCV axes)."""
    rotation, shift = world_to_camera[:, :3, :3], world_to_camera[:, None, :3, 3]
    in_camera = vertices @ rotation.transpose(0, 2, 1) + shift
    depth = in_camera[..., 2:]
    seen = depth[..., 0] > _NEAREST_M
    flat = in_camera[..., :2] / np.where(seen[..., None], depth, 1)
    points = flat * focal_px[:, None] + principal_point_px[:, None]
    # Far outside is outside; float32 in the drawing has no room for more.
    return Projection(np.clip(points, -1e5, 1e5), seen)


def projected(sample: Sample) -> Projection:
    """The sample's head in its frames."""
    return project(
        sample.vertices, sample.world_to_camera, sample.focal_px, sample.principal_point_px
    )


def inside_share(sample: Sample, projection: Projection) -> Float[np.ndarray, "F"]:
    """Of each frame's vertices the share that the image shows."""
    height, width = sample.alpha.shape[1:]
    points = projection.points_px
    inside = (points >= 0).all(-1) & (points[..., 0] <= width) & (points[..., 1] <= height)
    return (inside & projection.seen).mean(1)


def silhouettes(sample: Sample, projection: Projection) -> Float[np.ndarray, "F h w"]:
    """The mesh's silhouette in the sample's frames."""
    height, width = sample.alpha.shape[1:]
    drawn = []
    for points_px, seen in zip(projection.points_px, projection.seen):
        faces = sample.faces[seen[sample.faces].all(1)]
        drawn.append(mesh_silhouette(points_px, faces, max(height, width))[:height, :width])
    return np.stack(drawn)


def overlaps(sample: Sample, projection: Projection) -> list[SilhouetteOverlap]:
    """How mesh and matte fit in each frame; none where the images have no mattes."""
    if not sample.has_mattes:
        return []
    drawn = silhouettes(sample, projection)
    return [
        silhouette_overlap(mesh, matte, down_to_the_neck(mesh) & filmed)
        for mesh, matte, filmed in zip(drawn, sample.alpha, sample.filmed)
    ]
