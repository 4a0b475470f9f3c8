"""Ray casting with Embree: what a pixel's rays meet, finer where something begins or ends."""

from dataclasses import dataclass

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int

_EDGE_DEPTH_M = 0.015


@dataclass(frozen=True)
class Hits:
    """Where rays met a mesh; `triangle` is -1 where they met nothing."""

    triangle: Int[np.ndarray, "N"]
    weights: Float[np.ndarray, "N 3"]
    """Barycentric weights of the triangle's corners."""
    distance: Float[np.ndarray, "N"]


class RayScene:
    """Triangles that rays can be cast at; one Embree device serves all scenes.

    `kept` names the triangles that are there at all; hits count in the numbers of `faces`.
    """

    def __init__(
        self,
        device: EmbreeDevice,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        kept: Int[np.ndarray, "_"] | None = None,
    ) -> None:
        self._scene = EmbreeScene(device)
        there = faces if kept is None else faces[kept]
        self._mesh = TriangleMesh(self._scene, vertices.astype(np.float32), there.astype(np.int32))
        self._kept = None if kept is None else np.append(kept, -1).astype(np.int32)

    def cast(self, origins: Float[np.ndarray, "N 3"], directions: Float[np.ndarray, "N 3"]) -> Hits:
        """First hit of each ray; distances in lengths of `directions`."""
        found = self._scene.run(origins, directions, query="INTERSECT", output=True)
        second, third = found["u"], found["v"]
        weights = np.stack([1 - second - third, second, third], 1)
        triangle = found["primID"]
        if self._kept is not None:
            triangle = self._kept[triangle]
        return Hits(triangle, weights, found["tfar"])


@dataclass(frozen=True)
class RayCamera:
    """A pinhole that looks along -z from (0, height_m, distance_m), square images."""

    height_m: float
    distance_m: float
    focal_px: float
    size: int

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Where it stands."""
        return np.array([0.0, self.height_m, self.distance_m], np.float32)

    def directions(
        self, column: Float[np.ndarray, "N"], row: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N 3"]:
        """Unit directions of the rays through image points (the first pixel's centre is .5)."""
        across = (column - 0.5 * self.size) / self.focal_px
        down = (row - 0.5 * self.size) / self.focal_px
        rays = np.stack([across, -down, np.full_like(across, -1)], 1)
        rays /= np.sqrt(1 + across**2 + down**2)[:, None]
        return rays.astype(np.float32)

    def window(self, points: Float[np.ndarray, "N 3"]) -> tuple[int, int, int, int]:
        """First and end column, first and end row of the pixels that may see the points."""
        ahead = self.distance_m - points[:, 2]
        column = points[:, 0] / ahead * self.focal_px + 0.5 * self.size
        row = (self.height_m - points[:, 1]) / ahead * self.focal_px + 0.5 * self.size
        low, high = np.floor([column.min(), row.min()]) - 1, np.ceil([column.max(), row.max()]) + 1
        first = np.clip(low, 0, self.size).astype(int)
        end = np.clip(high, 0, self.size).astype(int)
        return int(first[0]), int(end[0]), int(first[1]), int(end[1])


@dataclass(frozen=True)
class PixelRays:
    """Rays that met something, with the pixel each belongs to and its place in the pattern."""

    pixel: Int[np.ndarray, "N"]
    pattern: Int[np.ndarray, "N"]
    directions: Float[np.ndarray, "N 3"]
    hits: Hits
    rays_per_pixel: Int[np.ndarray, "P"]


def cast_pixels(
    scene: RayScene,
    camera: RayCamera,
    points: Float[np.ndarray, "V 3"],
    material: Int[np.ndarray, "F"],
    supersampling: int,
) -> PixelRays:
    """Cast two rays a pixel, and `supersampling` squared where materials or depths part."""
    left, right, top, bottom = camera.window(points)
    columns, rows = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
    pixel = (rows * camera.size + columns).ravel()
    diagonal = np.array([0.25, 0.75])
    coarse = _cast_pattern(scene, camera, pixel, diagonal, diagonal)
    edge = _has_edge(coarse[3], coarse[5], material, (bottom - top, right - left))
    places = (np.arange(supersampling) + 0.5) / supersampling
    across, down = np.meshgrid(places, places)
    fine = _cast_pattern(scene, camera, pixel[edge], across.ravel(), down.ravel())
    rays_per_pixel = np.full(camera.size**2, len(diagonal))
    rays_per_pixel[pixel[edge]] = supersampling**2
    wanted = np.repeat(~edge, len(diagonal)), np.ones(len(fine[0]), bool)
    chosen = []
    for part, mask in zip((coarse, fine), wanted):
        met = mask & (part[3] >= 0)
        chosen.append([values[met] for values in part])
    pixel, pattern, directions, *hits = map(np.concatenate, zip(*chosen))
    return PixelRays(pixel, pattern, directions, Hits(*hits), rays_per_pixel)


def _cast_pattern(
    scene: RayScene, camera: RayCamera, pixel: np.ndarray, across: np.ndarray, down: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Of rays at the same places of each pixel: pixel, place in the pattern, direction, and the
    triangle, weights and distance of the hit.
    """
    column = (pixel[:, None] % camera.size + across).ravel()
    row = (pixel[:, None] // camera.size + down).ravel()
    directions = camera.directions(column, row)
    origins = np.broadcast_to(camera.centre, directions.shape).copy()
    number = np.tile(np.arange(len(across)), len(pixel))
    hits = scene.cast(origins, directions)
    owner = np.repeat(pixel, len(across))
    return owner, number, directions, hits.triangle, hits.weights, hits.distance


def _has_edge(
    triangle: np.ndarray, distance: np.ndarray, material: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Pixels whose rays, or those of their four neighbours, met other materials or depths."""
    met = triangle >= 0
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))

    def spread(values: np.ndarray) -> np.ndarray:
        first, second = (values[k::2].reshape(shape).astype(np.float32) for k in (0, 1))
        highest, lowest = np.maximum(first, second), np.minimum(first, second)
        return cv2.dilate(highest, cross) - cv2.erode(lowest, cross)

    kind = spread(np.where(met, material[triangle], -1))
    depth = spread(np.where(met, distance, 0))
    return ((kind > 0) | (depth > _EDGE_DEPTH_M)).ravel()
