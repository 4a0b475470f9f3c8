"""How the body moves from frame to frame, by the pattern of its clothes."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.cloth_colors import ClothColors
from rgbavatar_ns.tracking.torso.features import FollowedPoints, grid_within
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion, fit_rigid_motion

# A fresh key picture is taken when fewer of the points than this share are found again.
_FEW = 0.4
_MOST_POINTS = 160
_PERSON, _BACKGROUND = 0.9, 0.05
# The background's points only tell whether the camera moves. They are chosen in each half of the
# picture, and tell it where each has so many.
_LEAST_BACKGROUND, _MOST_BACKGROUND = 8, 24
# A camera moves all that it sees, something behind the person only a part: what all but this share
# of the points of a half do.
_STILLEST = 0.3
# Of fewer points none are wrong for sure, and a shirt that shows fewer has no pattern.
_RELIED_ON = 24
# How many frames of a body without a pattern pass until one is looked for again.
_PATIENCE = 15
# The head's shadow and the chin's are no pattern of the clothes: so far below the neck's joint.
_BELOW_NECK_M = 0.075
# Points so near to a place that is covered are not the body's, as a share of the picture's longer
# side: about one and a half times as far as the places are apart.
_HIDES_SHARE = 1 / 24
# When so much less of the clothes is covered than in the key picture, a fresh one is taken.
_CLEARED = 0.1
# Up to so much is no cover, but folds and light: then the clothes' colours are those of now.
_CLEAR = 0.02
# A run's first key picture is returned to where the body stands again much as it did in it, within
# such a share of the picture's longer side, and so many of the points are found: then nothing that
# went astray since is left.
_AGAIN_SHARE, _MANY = 1 / 16, 0.6


Matte = Callable[[], Float[np.ndarray, "h w"]]
"""The person's alpha of a frame's picture; found where it is asked for."""
MeshPx = Callable[[], Float[np.ndarray, "V 2"]]
"""The fitted head's mesh in a frame, in pixels of the source; found where it is asked for."""


@dataclass(frozen=True)
class BodySighting:
    """One frame: where points of the clothes are seen, in pixels of the source.

    `run` counts up where the body cannot be followed from the frame before. `seen_px` are the
    points last chosen, NaN where they are lost; `chosen_px` are those chosen anew in this frame,
    from here on, whose places count as far as their `certainty` says: none of a shirt without a
    pattern. `background_px` is how far the background has moved since then, NaN where too little of
    it is seen. `covered` is the share of the clothes in the picture that something is before, NaN
    where that is not known.
    """

    run: int
    seen_px: Float[np.ndarray, "P 2"]
    chosen_px: Float[np.ndarray, "Q 2"] | None
    certainty: Float[np.ndarray, "Q 2 2"] | None
    background_px: float
    covered: float = np.nan
    of_first: bool = False
    """Whether `seen_px` are the points that the run chose first, not the last ones, and go on to
    be followed."""

    @property
    def num_seen(self) -> int:
        """How many points are seen."""
        return np.count_nonzero(np.isfinite(self.seen_px[:, 0]))

    @property
    def is_followed(self) -> bool:
        """Whether enough points are seen for a motion that can be relied on."""
        return self.num_seen >= _RELIED_ON


@dataclass(frozen=True)
class KeyPicture:
    """A picture that is followed from: places of the body in the world when the run began."""

    body: FollowedPoints
    places_m: Float[np.ndarray, "P 3"]
    background: FollowedPoints
    covered: float
    """What share of the clothes was covered in it."""


@dataclass(frozen=True)
class FollowerState:
    """All that following goes on from.

    `start` places the body at rest where the run began, `motion` moves it from there to the last
    picture, where the key's points were near `near_px`, and its background's `beside_px`. `first`
    is the run's first key picture.
    """

    run: int
    plain_frames: int
    start: RigidMotion
    motion: RigidMotion
    first: KeyPicture | None
    key: KeyPicture | None
    near_px: Float[np.ndarray, "P 2"]
    beside_px: Float[np.ndarray, "B 2"]
    cloth: ClothColors | None

    @classmethod
    def before_the_first(cls) -> "FollowerState":
        """Nothing seen yet."""
        none, nowhere = RigidMotion.none(), np.zeros((0, 2))
        return cls(-1, 0, none, none, None, None, nowhere, nowhere, None)


class BodyFollower:
    """Follows the body of one person through a clip; call it with the frames in order.

    `scale` is the size of the given pictures by the source's. Another follower that is given this
    one's `state` goes on exactly alike.
    """

    def __init__(
        self,
        body: BodyMesh,
        camera: StillCamera,
        scale: float,
        state: FollowerState | None = None,
    ) -> None:
        self._body, self._scale = body, scale
        self._camera = camera.scaled(scale)
        self.state = state or FollowerState.before_the_first()

    def __call__(
        self,
        image_rgb: UInt8[np.ndarray, "h w 3"],
        neck_m: Float[np.ndarray, "3"],
        matte: Matte,
        mesh_px: MeshPx,
        is_cut: bool,
    ) -> BodySighting:
        """The next frame; `neck_m` is where its head says that the neck's joint is.

        `matte` and `mesh_px` are asked for key pictures alone; `is_cut` says that the picture has
        nothing to do with the one before.
        """
        gray = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY)
        key = None if is_cut else self.state.key
        background_px, covered, hidden_px, seen_px = np.nan, np.nan, np.zeros((0, 2)), None
        of_first = False
        if key is not None:
            background_px = self._background_px(key, gray)
            covered, hidden_px = self._covered(image_rgb)
            seen_px = self._first_again(key, gray, hidden_px)
            of_first = seen_px is not None
            if seen_px is None:
                seen_px = self._followed(key, self.state.near_px, gray, hidden_px)
        if seen_px is None:
            self._begin_run(neck_m)
            seen_px, covered, hidden_px = np.zeros((0, 2)), np.nan, np.zeros((0, 2))
        chosen_px, certainty = None, None
        if self._wants_key(seen_px, covered):
            key = self._take_key(image_rgb, gray, matte(), mesh_px(), covered, hidden_px)
            if key is not None:
                chosen_px, certainty = self._in_source(key.body.points_px), key.body.certainty
        seen_px = self._in_source(seen_px)
        return BodySighting(
            self.state.run, seen_px, chosen_px, certainty, background_px, covered, of_first
        )

    def _begin_run(self, neck_m: Float[np.ndarray, "3"]) -> None:
        """Nothing leads here from the frames before."""
        self.state = replace(
            self.state,
            run=self.state.run + 1,
            start=RigidMotion(np.eye(3), neck_m - self._body.neck_m),
            motion=RigidMotion.none(),
            plain_frames=_PATIENCE,
            first=None,
            key=None,
            cloth=None,
        )

    def _wants_key(self, seen_px: Float[np.ndarray, "P 2"], covered: float) -> bool:
        """Whether to choose points anew; on a plain shirt only now and then."""
        if len(seen_px):
            assert self.state.key is not None
            cleared = covered + _CLEARED < self.state.key.covered
            return bool(cleared or np.isfinite(seen_px[:, 0]).mean() < _FEW)
        self.state = replace(self.state, plain_frames=self.state.plain_frames + 1)
        return self.state.plain_frames % _PATIENCE == 1

    def _in_source(self, points_px: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        return (points_px + 0.5) / self._scale

    def _covered(
        self, image_rgb: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[float, Float[np.ndarray, "C 2"]]:
        """What share of the clothes is covered, and where, if the body is where it last was."""
        cloth = self.state.cloth
        if cloth is None:
            return np.nan, np.zeros((0, 2))
        px = self._camera.project(self.state.motion(cloth.places_m))
        otherwise, share = cloth.covered(image_rgb, px)
        return share, px[otherwise]

    def _first_again(
        self, key: KeyPicture, gray: UInt8[np.ndarray, "h w"], hidden_px: Float[np.ndarray, "C 2"]
    ) -> Float[np.ndarray, "P 2"] | None:
        """The points of the run's first key picture, if it serves again; None if it does not."""
        first, before = self.state.first, self.state
        if first is None or first is key or not len(first.places_m):
            return None
        near_px = self._camera.project(before.motion(first.places_m))
        moved_px = np.linalg.norm(near_px - first.body.points_px, axis=1).mean()
        if moved_px > _AGAIN_SHARE * max(gray.shape):
            return None
        seen_px = self._followed(first, near_px, gray, hidden_px)
        if seen_px is None or np.isfinite(seen_px[:, 0]).mean() < _MANY:
            self.state = before
            return None
        beside_px = first.background.points_px
        self.state = replace(self.state, key=first, beside_px=beside_px)
        return seen_px

    def _followed(
        self,
        key: KeyPicture,
        near_px: Float[np.ndarray, "P 2"],
        gray: UInt8[np.ndarray, "h w"],
        hidden_px: Float[np.ndarray, "C 2"],
    ) -> Float[np.ndarray, "P 2"] | None:
        """The points in this picture, NaN where lost; None where they show no motion of a body."""
        if not len(key.places_m):
            return np.zeros((0, 2))
        px, seen = key.body.found_in(gray, near_px)
        seen &= ~_near_any(px, hidden_px, _HIDES_SHARE * max(gray.shape))
        pivot = self.state.start(self._body.neck_m)
        fitted = fit_rigid_motion(
            key.places_m[seen],
            px[seen],
            key.body.certainty[seen],
            self._camera,
            1.0,
            self.state.motion,
            pivot,
        )
        if fitted is None:
            return None
        near_px = self._camera.project(fitted[0](key.places_m))
        self.state = replace(self.state, motion=fitted[0], near_px=near_px)
        return np.where(seen[:, None], px, np.nan)

    def _background_px(self, key: KeyPicture, gray: UInt8[np.ndarray, "h w"]) -> float:
        points = key.background
        # Most cameras stand, and on a chequered chair what is looked for elsewhere is found there.
        px, seen = points.found_in(gray, points.points_px)
        if seen.sum() < _FEW * len(seen):
            px, seen = points.found_in(gray, self.state.beside_px)
        moved = np.linalg.norm(px - points.points_px, axis=1)
        onward = np.median((px - points.points_px)[seen], axis=0) if seen.any() else 0.0
        self.state = replace(self.state, beside_px=points.points_px + onward)
        # Somebody beside the person moves in one half, the camera in both.
        left = points.points_px[:, 0] < gray.shape[1] / 2
        halves = [moved[seen & half] for half in (left, ~left)]
        if min(map(len, halves)) < _LEAST_BACKGROUND:
            return np.nan
        return float(min(np.quantile(half, _STILLEST) for half in halves)) / self._scale

    def _take_key(
        self,
        image_rgb: UInt8[np.ndarray, "h w 3"],
        gray: UInt8[np.ndarray, "h w"],
        matte: Float[np.ndarray, "h w"],
        mesh_px: Float[np.ndarray, "V 2"],
        covered: float,
        hidden_px: Float[np.ndarray, "C 2"],
    ) -> KeyPicture | None:
        """Choose points of the body anew in this picture, but not of what is before it.

        None where it shows too few, and those of the key picture of before still serve.
        """
        state = self.state
        placed = state.motion.after(state.start)
        region = (matte > _PERSON) & ~self._of_head(mesh_px, placed, gray.shape)
        for x, y in np.round(hidden_px).astype(int).tolist():
            reach = round(_HIDES_SHARE * max(gray.shape))
            region[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1] = False
        chosen = FollowedPoints.chosen(gray, region, _MOST_POINTS)
        places, near = self._body.lifted(chosen.points_px, placed, self._camera)
        if near.sum() < _RELIED_ON:
            if state.key is not None and len(state.key.places_m):
                return None
            near = np.zeros_like(near)
        chosen, places = chosen.select(near), state.motion.undone()(places[near])
        beside = _beside(gray, matte < _BACKGROUND)
        key = KeyPicture(chosen, places, beside, 0.0 if np.isnan(covered) else covered)
        cloth = self._cloth(image_rgb, region, covered) if len(places) else None
        self.state = replace(
            state,
            first=state.first or (key if len(places) else None),
            key=key,
            near_px=chosen.points_px,
            beside_px=beside.points_px,
            cloth=cloth,
        )
        return key

    def _cloth(
        self,
        image_rgb: UInt8[np.ndarray, "h w 3"],
        region: Bool[np.ndarray, "h w"],
        covered: float,
    ) -> ClothColors:
        """The clothes' colours; what covers them is not learned."""
        state = self.state
        if state.cloth is not None:
            px = self._camera.project(state.motion(state.cloth.places_m))
            clear = not covered > _CLEAR
            return state.cloth.renewed(image_rgb, px) if clear else state.cloth
        px = grid_within(region)
        places, near = self._body.lifted(px, state.motion.after(state.start), self._camera)
        return ClothColors.of(image_rgb, state.motion.undone()(places[near]), px[near])

    def _of_head(
        self,
        vertices_px: Float[np.ndarray, "V 2"],
        placed: RigidMotion,
        shape: tuple[int, ...],
    ) -> Bool[np.ndarray, "h w"]:
        """Where head and neck may be, and all that is higher than the shoulders."""
        height, width = shape
        neck = placed(self._body.neck_m)
        px_per_m = self._camera.px_per_m(neck[2])
        mask = self._body.head_px(vertices_px * self._scale - 0.5, width, height, px_per_m)
        below = self._camera.project(placed(self._body.neck_m - [0, _BELOW_NECK_M, 0]))
        up = self._camera.project(placed(self._body.neck_m)) - below
        rows, columns = np.mgrid[:height, :width]
        above = (columns - below[0]) * up[0] + (rows - below[1]) * up[1] > 0
        return mask | above


def _near_any(
    points_px: Float[np.ndarray, "P 2"], others_px: Float[np.ndarray, "C 2"], reach_px: float
) -> Bool[np.ndarray, "P"]:
    """Which points lie near one of the others, along both axes."""
    apart = np.abs(points_px[:, None] - others_px).max(-1)
    return (apart <= reach_px).any(1)


def _beside(gray: UInt8[np.ndarray, "h w"], region: Bool[np.ndarray, "h w"]) -> FollowedPoints:
    """Points of the background, in the picture's left half and in its right one."""
    left = np.arange(gray.shape[1]) < gray.shape[1] / 2
    halves = [
        FollowedPoints.chosen(gray, region & half, _MOST_BACKGROUND) for half in (left, ~left)
    ]
    points = np.concatenate([half.points_px for half in halves])
    return FollowedPoints(gray, points, np.concatenate([half.certainty for half in halves]))
