"""Draws the demo person: posed surface, glasses and hair in, RGBA image with soft alpha out."""

from dataclasses import dataclass

import cv2
import numpy as np
from embreex.rtcore import EmbreeDevice
from jaxtyping import Float, UInt8

from rgbavatar_ns.synthetic.performer.glasses import Glasses, Mesh, joined
from rgbavatar_ns.synthetic.performer.hair import HairPiece
from rgbavatar_ns.synthetic.performer.paint import Paint, paint_eye
from rgbavatar_ns.synthetic.performer.regions import smooth
from rgbavatar_ns.synthetic.performer.surface import PARTS, PosedSurface, TrueSurface, unit
from rgbavatar_ns.synthetic.performer.wrinkles import WRINKLES
from rgbavatar_ns.synthetic.renderer.lighting import (
    KEY_DIRECTION,
    KEY_SPREAD,
    Samples,
    reflection,
    shade,
    to_srgb,
)
from rgbavatar_ns.synthetic.renderer.raycast import PixelRays, RayCamera, RayScene, cast_pixels

_FRAME_MATERIAL, _HAIR_MATERIAL = len(PARTS), len(PARTS) + 1
_AMBIENT_RAYS = 48
_AMBIENT_REACH_M = 0.12
_SHARPNESS = np.array([16.0, 260.0, 260.0, 70.0, 70.0, 40.0, 60.0, 12.0], np.float32)
_TRANSLUCENCY = np.array([1.0, 0.3, 0.3, 0.4, 0.4, 1.0, 0.0, 0.0], np.float32)
_SHADOW = 0.6
_FRAME_SHADOW = 0.25
_FRAME_COLOR = np.array([0.190, 0.095, 0.055], np.float32)


@dataclass(frozen=True)
class Moment:
    """All that changes from frame to frame."""

    tracked: Float[np.ndarray, "V 3"]
    """The head model's vertices in the world."""
    activations: Float[np.ndarray, "W"]
    """Of the groups of wrinkles."""
    blush: float
    jaw_open: float
    """From 0, closed, to 1, wide open."""
    head_rotation: Float[np.ndarray, "3 3"]
    head_shift_m: Float[np.ndarray, "3"]
    """The skull's rigid motion, which the glasses follow."""


class DemoRenderer:
    """Renders moments of one person; may be used by several threads.

    `at_rest` and `jaw_open` are the head model's vertices with closed and with wide open mouth:
    from them it is found how much of the room each point sees.
    """

    def __init__(
        self,
        surface: TrueSurface,
        paint: Paint,
        glasses: Glasses | None,
        hair: HairPiece | None,
        at_rest: Float[np.ndarray, "V 3"],
        jaw_open: Float[np.ndarray, "V 3"],
        camera: RayCamera,
        supersampling: int,
        *,
        light_follows_head: bool = False,
    ) -> None:
        self._device = EmbreeDevice()
        self._surface, self._paint, self._glasses, self._hair = surface, paint, glasses, hair
        self._camera, self._supersampling = camera, supersampling
        self._light_follows_head = light_follows_head
        still = np.zeros(len(WRINKLES))
        self._openness = [
            self._ambient(surface.pose(vertices, still)) for vertices in (at_rest, jaw_open)
        ]
        worn = [] if glasses is None else [(glasses.frame, _FRAME_MATERIAL)]
        worn += [] if hair is None else [(hair.mesh, _HAIR_MATERIAL)]
        self._worn = joined([mesh for mesh, _ in worn]) if worn else None
        faces, material = [surface.faces], [surface.face_part]
        if self._worn is not None:
            faces.append(self._worn.faces + len(surface.template))
            material += [np.full(len(mesh.faces), kind, np.int8) for mesh, kind in worn]
        self._faces, self._material = np.concatenate(faces), np.concatenate(material)

    def _ambient(self, posed: PosedSurface) -> Float[np.ndarray, "V"]:
        """Share of the hemisphere over each vertex from which light comes, cosine-weighted."""
        scene = RayScene(self._device, posed.vertices, self._surface.faces)
        spiral = (np.arange(_AMBIENT_RAYS) + 0.5) / _AMBIENT_RAYS
        turn = np.arange(_AMBIENT_RAYS) * np.pi * (3 - np.sqrt(5))
        radius = np.sqrt(spiral)
        local = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - spiral)], 1)
        n = posed.normals
        helper = np.where(np.abs(n[:, 1:2]) < 0.9, [[0, 1.0, 0]], [[1.0, 0, 0]])
        first = unit(np.cross(n, helper))
        second = np.cross(n, first)
        free = np.zeros(len(n), np.float32)
        start = (posed.vertices + 8e-4 * n).astype(np.float32)
        for x, y, z in local:
            direction = (x * first + y * second + z * n).astype(np.float32)
            hits = scene.cast(start, direction)
            free += (hits.triangle < 0) | (hits.distance > _AMBIENT_REACH_M)
        return free / _AMBIENT_RAYS

    def render(self, moment: Moment) -> UInt8[np.ndarray, "S S 4"]:
        """Draw one moment: sRGB with straight alpha."""
        tilt = float(0.35 * moment.head_rotation[0, 1] - 0.25 * moment.head_rotation[0, 2])
        posed = self._surface.pose(moment.tracked, moment.activations, tilt)
        vertices, normals = posed.vertices, posed.normals
        if self._worn is not None:
            worn = self._worn.moved(moment.head_rotation, moment.head_shift_m)
            vertices = np.concatenate([vertices, worn.vertices])
            normals = np.concatenate([normals, worn.normals])
        still = np.eye(3, dtype=np.float32)
        light_to_world = moment.head_rotation if self._light_follows_head else still
        key = (light_to_world @ KEY_DIRECTION).astype(np.float32)
        kept = self._may_matter(vertices, normals, key)
        scene = RayScene(self._device, vertices, self._faces, kept)
        rays = cast_pixels(scene, self._camera, vertices, self._material, self._supersampling)
        light = shade(self._samples(moment, scene, vertices, normals, rays, key), light_to_world)
        if self._glasses is not None:
            lenses = self._glasses.lenses.moved(moment.head_rotation, moment.head_shift_m)
            light = self._through_lenses(lenses, rays, light)
        return self._develop(rays, to_srgb(light))

    def _may_matter(self, vertices: np.ndarray, normals: np.ndarray, key: np.ndarray) -> np.ndarray:
        """Triangles that face the camera or the key lamp, or are no skin; the rest of the head is
        hidden behind these and throws no shadow that they do not throw.
        """
        to_eye = unit(self._camera.centre - vertices)
        facing = np.maximum((normals * to_eye).sum(1), normals @ key) > -0.35
        return np.flatnonzero(facing[self._faces].any(1) | (self._material != 0))

    def _samples(
        self,
        moment: Moment,
        scene: RayScene,
        vertices: np.ndarray,
        normals: np.ndarray,
        rays: PixelRays,
        key: np.ndarray,
    ) -> Samples:
        hits = rays.hits
        material = self._material[hits.triangle]
        n = _interpolate(normals, self._faces[hits.triangle], hits.weights)
        albedo = np.tile(_FRAME_COLOR, (len(n), 1))
        gloss = np.full(len(n), 0.5, np.float32)
        openness = np.ones(len(n), np.float32)
        body = np.flatnonzero(material < _FRAME_MATERIAL)
        corners = self._faces[hits.triangle[body]]
        weights = hits.weights[body]
        share = np.float32(moment.jaw_open)
        seen = (1 - share) * self._openness[0] + share * self._openness[1]
        openness[body] = _interpolate(seen[:, None], corners, weights)[:, 0]
        openness[body] = self._brighten_teeth(openness[body], material[body], corners)
        color, tilted = self._textured(moment, hits.triangle[body], weights, n[body])
        n[body] = tilted
        albedo[body], gloss[body] = color[:, :3], color[:, 3]
        eye = (material == 1) | (material == 2)
        place = _interpolate(
            self._surface.template, self._faces[hits.triangle[eye]], hits.weights[eye]
        )
        albedo[eye], gloss[eye] = paint_eye(place)
        if self._hair is not None and self._worn is not None:
            piece = material == _HAIR_MATERIAL
            corners = self._faces[hits.triangle[piece]] - len(self._surface.template)
            place = _interpolate(self._worn.vertices, corners, hits.weights[piece])
            albedo[piece], gloss[piece] = self._hair.paint(place)
        n = unit(n)
        to_eye = -rays.directions
        n = np.where((n * to_eye).sum(1, keepdims=True) < -0.2, -n, n)
        at = self._camera.centre + rays.directions * hits.distance[:, None]
        return Samples(
            normals=n,
            to_eye=to_eye,
            albedo=albedo,
            gloss=gloss,
            sharpness=_SHARPNESS[material],
            translucency=_TRANSLUCENCY[material],
            openness=openness,
            lit=self._lit(scene, at, n, rays.pattern, key),
        )

    def _brighten_teeth(
        self, openness: np.ndarray, material: np.ndarray, corners: np.ndarray
    ) -> np.ndarray:
        """Light bounces within the mouth: front teeth and tongue are never as dark as its depth."""
        inner = material >= 3
        depth = self._surface.template[corners[inner, 0], 2]
        result = openness.copy()
        result[inner] = np.maximum(result[inner], 0.75 * smooth(depth, 0.018, 0.046))
        return result

    def _textured(
        self, moment: Moment, triangle: np.ndarray, weights: np.ndarray, n: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colour and gloss [N, 4], and normals tilted by the slope of folds, pores and strands."""
        color_map, slope_map = self._paint.folded(moment.activations, moment.blush)
        uv = _interpolate(self._surface.uv, self._surface.uv_faces[triangle], weights)
        size = color_map.shape[0]
        column, row = uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5
        color, slope = _sample(color_map, column, row), _sample(slope_map, column, row)
        right, up = self._surface.tangents(moment.tracked)
        coarse = triangle // 4
        return color, n - slope[:, :1] * right[coarse] - slope[:, 1:] * up[coarse]

    def _lit(
        self, scene: RayScene, at: np.ndarray, n: np.ndarray, pattern: np.ndarray, key: np.ndarray
    ) -> Float[np.ndarray, "N"]:
        """How far the key lamp is seen, each ray towards another place on it.

        The thin frame of the glasses hides only a part of a lamp as large as this one.
        """
        turn = 2.4 * pattern + 0.7
        radius = KEY_SPREAD * np.sqrt((0.37 + 0.618034 * pattern) % 1)
        across = unit(np.cross(key, [0.0, 1.0, 0.0]))
        upwards = np.cross(across, key)
        offset = (radius * np.cos(turn))[:, None] * across
        offset = offset + (radius * np.sin(turn))[:, None] * upwards
        direction = unit(key + offset).astype(np.float32)
        lit = np.zeros(len(n), np.float32)
        facing = np.flatnonzero(n @ key > -0.25)
        start = at[facing] + 6e-4 * n[facing] + 6e-4 * key
        blocked_by = scene.cast(start.astype(np.float32), direction[facing]).triangle
        shadow = np.where(self._material[blocked_by] == _FRAME_MATERIAL, _FRAME_SHADOW, _SHADOW)
        lit[facing] = np.where(blocked_by < 0, 1.0, 1.0 - shadow)
        return lit

    def _through_lenses(self, lenses: Mesh, rays: PixelRays, light: np.ndarray) -> np.ndarray:
        """Light after the lenses, where a lens stands before what a ray met."""
        left, right, top, bottom = self._camera.window(lenses.vertices)
        column, row = rays.pixel % self._camera.size, rays.pixel // self._camera.size
        inside = (column >= left) & (column < right) & (row >= top) & (row < bottom)
        near = np.flatnonzero(inside)
        directions = rays.directions[near]
        origins = np.broadcast_to(self._camera.centre, directions.shape).copy()
        hits = RayScene(self._device, lenses.vertices, lenses.faces).cast(origins, directions)
        before = (hits.triangle >= 0) & (hits.distance < rays.hits.distance[near])
        n = unit(
            _interpolate(lenses.normals, lenses.faces[hits.triangle[before]], hits.weights[before])
        )
        result = light.copy()
        glint = reflection(n, -directions[before])[:, None] * np.array([0.92, 1.0, 0.98])
        result[near[before]] = 0.93 * light[near[before]] + glint
        return result

    def _develop(self, rays: PixelRays, color: np.ndarray) -> UInt8[np.ndarray, "S S 4"]:
        """Mean colour of the rays that met something, and their share as alpha."""
        size = self._camera.size
        met = np.bincount(rays.pixel, minlength=size * size)
        image = np.zeros((size * size, 4))
        for channel in range(3):
            total = np.bincount(rays.pixel, color[:, channel], size * size)
            image[:, channel] = total / np.maximum(met, 1)
        image[:, 3] = met / rays.rays_per_pixel
        return (image * 255 + 0.5).astype(np.uint8).reshape(size, size, 4)


def _interpolate(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Vertex values [V, C] at barycentric places [N, C]."""
    return (
        values[corners[:, 0]] * weights[:, :1]
        + values[corners[:, 1]] * weights[:, 1:2]
        + values[corners[:, 2]] * weights[:, 2:]
    )


def _sample(texture: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Bilinear lookup at texel coordinates; the border repeats."""
    width = 1024  # OpenCV takes pictures of places, at most 32,767 a side
    height = -(-len(column) // width)
    padded = np.zeros((2, height * width), np.float32)
    padded[0, : len(column)], padded[1, : len(row)] = column, row
    x, y = padded.reshape(2, height, width)
    found = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(height * width, -1)[: len(column)]
