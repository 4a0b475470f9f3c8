"""Ray casting with Embree: what a pixel's rays meet, finer where something begins or ends."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Int

_EDGE_DEPTH_M = 0.006


@dataclass(frozen=True)
class Hits:
    """Where rays met a mesh; `triangle` is -1 where they met nothing."""

    triangle: Int[np.ndarray, "N"]
    weights: Float[np.ndarray, "N 3"]
    """Barycentric weights of the triangle's corners."""
    distance: Float[np.ndarray, "N"]


class RayScene:
    """Triangles that rays can be cast at; one Embree device serves all scenes."""

    def __init__(
        self,
        device: EmbreeDevice,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
    ) -> None:
        self._scene = EmbreeScene(device)
        self._mesh = TriangleMesh(self._scene, vertices.astype(np.float32), faces.astype(np.int32))

    def cast(self, origins: Float[np.ndarray, "N 3"], directions: Float[np.ndarray, "N 3"]) -> Hits:
        """First hit of each ray; distances in lengths of `directions`."""
        found = self._scene.run(origins, directions, query="INTERSECT", output=True)
        second, third = found["u"], found["v"]
        weights = np.stack([1 - second - third, second, third], 1)
        return Hits(found["primID"], weights, found["tfar"])

    def is_free(
        self,
        origins: Float[np.ndarray, "N 3"],
        directions: Float[np.ndarray, "N 3"],
        reach_m: float = np.inf,
    ) -> Bool[np.ndarray, "N"]:
        """Whether each ray (unit directions) meets nothing within `reach_m`."""
        if not len(origins):
            return np.zeros(0, bool)
        hits = self.cast(origins, directions)
        return (hits.triangle < 0) | (hits.distance > reach_m)


@dataclass(frozen=True)
class StillCamera:
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
    camera: StillCamera,
    points: Float[np.ndarray, "V 3"],
    material: Int[np.ndarray, "F"],
    supersampling: int,
) -> PixelRays:
    """Cast 2 x 2 rays a pixel, and `supersampling` squared where materials or depths part."""
    left, right, top, bottom = camera.window(points)
    columns, rows = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
    pixel = (rows * camera.size + columns).ravel()
    rays_per_pixel = np.full(camera.size**2, 4)
    parts = [_cast_grid(scene, camera, pixel, 2)]
    if supersampling != 2:
        edge = _has_edge(parts[0][3], material, len(pixel))
        rays_per_pixel[pixel[edge]] = supersampling**2
        kept = np.repeat(~edge, 4)
        parts = [_chosen(parts[0], kept), _cast_grid(scene, camera, pixel[edge], supersampling)]
    met = [_chosen(part, part[3].triangle >= 0) for part in parts]
    return PixelRays(
        np.concatenate([part[0] for part in met]),
        np.concatenate([part[1] for part in met]),
        np.concatenate([part[2] for part in met]),
        Hits(
            np.concatenate([part[3].triangle for part in met]),
            np.concatenate([part[3].weights for part in met]),
            np.concatenate([part[3].distance for part in met]),
        ),
        rays_per_pixel,
    )


_Grid = tuple[np.ndarray, np.ndarray, np.ndarray, Hits]


def _cast_grid(scene: RayScene, camera: StillCamera, pixel: np.ndarray, count: int) -> _Grid:
    """Pixel, place in the pattern, direction and hit of count x count rays for each pixel."""
    places = (np.arange(count) + 0.5) / count
    across, down = np.meshgrid(places, places)
    column = (pixel[:, None] % camera.size + across.ravel()).ravel()
    row = (pixel[:, None] // camera.size + down.ravel()).ravel()
    directions = camera.directions(column, row)
    origins = np.broadcast_to(camera.centre, directions.shape).copy()
    pattern = np.tile(np.arange(count * count), len(pixel))
    return np.repeat(pixel, count * count), pattern, directions, scene.cast(origins, directions)


def _chosen(part: _Grid, mask: np.ndarray) -> _Grid:
    pixel, pattern, directions, hits = part
    chosen = Hits(hits.triangle[mask], hits.weights[mask], hits.distance[mask])
    return pixel[mask], pattern[mask], directions[mask], chosen


def _has_edge(hits: Hits, material: np.ndarray, count: int) -> np.ndarray:
    """Pixels whose rays met different materials or depths."""
    met = hits.triangle >= 0
    kind = np.where(met, material[hits.triangle], -1).reshape(count, -1)
    depth = np.where(met, hits.distance, 0).reshape(count, -1)
    return (np.ptp(kind, 1) > 0) | (np.ptp(depth, 1) > _EDGE_DEPTH_M)
