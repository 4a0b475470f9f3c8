"""How the body moves from frame to frame, by the pattern of its clothes."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.features import FollowedPoints
from rgbavatar_ns.tracking.torso.rigid_motion import LEAST_POINTS, RigidMotion, fit_rigid_motion

# A fresh key picture is taken when fewer of the points than this share are found again.
_FEW = 0.4
_MOST_POINTS = 160
_PERSON, _BACKGROUND = 0.9, 0.05
# The background's points only tell by their median whether the camera moves.
_LEAST_BACKGROUND, _MOST_BACKGROUND = 12, 48
# How many frames of a body without a pattern pass until one is looked for again.
_PATIENCE = 15
# The head's shadow and the chin's are no pattern of the clothes: so far below the neck's joint.
_BELOW_NECK_M = 0.075


MatteOf = Callable[[UInt8[np.ndarray, "h w 3"]], Float[np.ndarray, "h w"]]
"""The person's alpha of a picture."""
MeshPx = Callable[[], Float[np.ndarray, "V 2"]]
"""The fitted head's mesh in a frame, in pixels of the source; found where it is asked for."""


@dataclass(frozen=True)
class BodySighting:
    """One frame: where points of the clothes are seen, in pixels of the source.

    `run` counts up where the body cannot be followed from the frame before. `seen_px` are the
    points last chosen, NaN where they are lost; `chosen_px` are those chosen anew in this frame,
    from here on, whose places count as far as their `certainty` says. `background_px` is how far
    the background has moved since then, NaN where too little of it is seen.
    """

    run: int
    seen_px: Float[np.ndarray, "P 2"]
    chosen_px: Float[np.ndarray, "Q 2"] | None
    certainty: Float[np.ndarray, "Q 2 2"] | None
    background_px: float


@dataclass(frozen=True)
class _Key:
    """A picture that is followed from: places of the body in the world when the run began."""

    body: FollowedPoints
    places_m: Float[np.ndarray, "P 3"]
    background: FollowedPoints


class BodyFollower:
    """Follows the body of one person through a clip; call it with the frames in order.

    `scale` is the size of the given pictures by the source's. `matte_of` gives the person's alpha
    of a picture; it is asked for key pictures alone.
    """

    def __init__(
        self, body: BodyMesh, camera: StillCamera, scale: float, matte_of: MatteOf
    ) -> None:
        self._body, self._scale, self._matte_of = body, scale, matte_of
        self._camera = camera.scaled(scale)
        self._key: _Key | None = None
        self._run = -1
        self._start = RigidMotion.none()
        self._motion = RigidMotion.none()
        self._near = (np.zeros((0, 2)), np.zeros((0, 2)))
        self._plain_frames = 0

    def __call__(
        self,
        image_rgb: UInt8[np.ndarray, "h w 3"],
        neck_m: Float[np.ndarray, "3"],
        mesh_px: MeshPx,
        is_cut: bool,
    ) -> BodySighting:
        """The next frame; `neck_m` is where its head says that the neck's joint is.

        `mesh_px` is asked for key pictures alone; `is_cut` says that the picture has nothing to do
        with the one before.
        """
        gray = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY)
        followed = self._key is not None and not is_cut
        background_px = self._background_px(gray) if followed else np.nan
        seen_px = self._followed(gray) if followed else None
        if seen_px is None:
            self._run += 1
            self._start = RigidMotion(np.eye(3), neck_m - self._body.neck_m)
            self._motion = RigidMotion.none()
            seen_px = np.zeros((0, 2))
            self._plain_frames = _PATIENCE
        chosen_px, certainty = None, None
        if self._wants_key(seen_px):
            chosen_px = self._in_source(self._take_key(image_rgb, gray, mesh_px))
            assert self._key is not None
            certainty = self._key.body.certainty
        seen_px = self._in_source(seen_px)
        return BodySighting(self._run, seen_px, chosen_px, certainty, background_px)

    def _wants_key(self, seen_px: Float[np.ndarray, "P 2"]) -> bool:
        """Whether to choose points anew; on a plain shirt only now and then."""
        if len(seen_px):
            return bool(np.isfinite(seen_px[:, 0]).mean() < _FEW)
        self._plain_frames += 1
        return self._plain_frames % _PATIENCE == 1

    def _in_source(self, points_px: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        return (points_px + 0.5) / self._scale

    def _followed(self, gray: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "P 2"] | None:
        """The points in this picture, NaN where lost; None where they show no motion of a body."""
        assert self._key is not None
        key = self._key
        if len(key.places_m) < LEAST_POINTS:
            return np.zeros((0, 2))
        px, seen = key.body.found_in(gray, self._near[0])
        pivot = self._start(self._body.neck_m)
        fitted = fit_rigid_motion(
            key.places_m[seen],
            px[seen],
            key.body.certainty[seen],
            self._camera,
            self._motion,
            pivot,
        )
        if fitted is None:
            return None
        self._motion = fitted[0]
        self._near = self._camera.project(self._motion(key.places_m)), self._near[1]
        return np.where(seen[:, None], px, np.nan)

    def _background_px(self, gray: UInt8[np.ndarray, "h w"]) -> float:
        assert self._key is not None
        points = self._key.background
        px, seen = points.found_in(gray, self._near[1])
        if seen.sum() < _LEAST_BACKGROUND:
            return np.nan
        self._near = self._near[0], np.where(seen[:, None], px, points.points_px)
        moved = np.linalg.norm(px[seen] - points.points_px[seen], axis=1)
        return float(np.median(moved)) / self._scale

    def _take_key(
        self,
        image_rgb: UInt8[np.ndarray, "h w 3"],
        gray: UInt8[np.ndarray, "h w"],
        mesh_px: MeshPx,
    ) -> Float[np.ndarray, "Q 2"]:
        """Choose points of the body anew in this picture."""
        matte = self._matte_of(image_rgb)
        placed = self._motion.after(self._start)
        region = (matte > _PERSON) & ~self._of_head(mesh_px(), placed, gray.shape)
        chosen = FollowedPoints.chosen(gray, region, _MOST_POINTS)
        places, near = self._body.lifted(chosen.points_px, placed, self._camera)
        chosen, places = chosen.select(near), self._motion.undone()(places[near])
        beside = FollowedPoints.chosen(gray, matte < _BACKGROUND, _MOST_BACKGROUND)
        self._key = _Key(chosen, places, beside)
        self._near = chosen.points_px, beside.points_px
        return chosen.points_px

    def _of_head(
        self,
        vertices_px: Float[np.ndarray, "V 2"],
        placed: RigidMotion,
        shape: tuple[int, ...],
    ) -> Bool[np.ndarray, "h w"]:
        """Where head and neck may be, and all that is higher than the shoulders."""
        height, width = shape
        neck = placed(self._body.neck_m)
        by_depth = self._camera.focal_px / (self._camera.distance_m - neck[2])
        mask = self._body.head_px(vertices_px * self._scale - 0.5, width, height, by_depth)
        below = self._camera.project(placed(self._body.neck_m - [0, _BELOW_NECK_M, 0]))
        up = self._camera.project(placed(self._body.neck_m)) - below
        rows, columns = np.mgrid[:height, :width]
        above = (columns - below[0]) * up[0] + (rows - below[1]) * up[1] > 0
        return mask | above
