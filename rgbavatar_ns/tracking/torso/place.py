"""Where the body is in every frame, out of how it moves, where the head is, and the shoulders."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.follow import BodySighting
from rgbavatar_ns.tracking.torso.outline_motion import OutlinePath
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion
from rgbavatar_ns.tracking.torso.solve import run_motions

# Motion below this, of the neck's joint and the shoulders', is what a body that keeps still shows:
# breath, and the noise of the points.
_STILL_M = 0.004
_SMOOTH_FRAMES = 1.5
# A neck carries its head about three centimetres from where it mostly is; the head's own distance
# is known to some centimetres. Where a body seems to be farther from its head, it is none.
_NECK_REACH_M = 0.08
# One camera hardly tells how a body is turned: people sit before it, and only what is plainly
# otherwise counts. The detector's own error is some 6 degrees sideways and 2 in the tilt.
_DOUBTED_YAW_RAD, _DOUBTED_ROLL_RAD = 0.2, 0.035
# Where so much of the clothes looks otherwise, something is before them: folds are less.
_COVERED = 0.05
_LEAST_FRAMES = 10
# So many points are the shirt's own, whatever its outline does: an arm moves that, a neighbour.
# Fewer are its own where their motion is off the outline's by less than this (root mean square), or
# by less than this share of how far that goes: half of its squares.
_MANY_POINTS, _AGREES_M, _UNEXPLAINED = 48, 0.003, 0.5**0.5
# A camera that stands leaves the background within so many pixels of the followed picture.
_STANDS_PX = 0.5
ROUNDS = 5
"""How often each frame is visited."""


@dataclass(frozen=True)
class SeenShoulders:
    """Shoulders in one frame: where, left first, in pixels of the source, and the chest's turn."""

    position: int
    shoulders_px: Float[np.ndarray, "2 2"]
    yaw_rad: float


@dataclass(frozen=True)
class BodyPlaces:
    """The body's pose in each of F frames: what rests at the neck's joint is at `neck_m`."""

    rotation: Float[np.ndarray, "F 3 3"]
    neck_m: Float[np.ndarray, "F 3"]
    still: bool
    """Whether it keeps still all the time."""
    followed: float
    """Share of the frames in which the clothes showed its motion."""
    background_px: float
    """How far the background moves over the clip, pixels of the source; NaN where none is seen."""
    shoulders_up_cm: float = 0.0
    """How much higher the shoulders are than the mesh has them."""
    covered_share: float = 0.0
    """Share of the frames in which something is before the body."""
    seen_cm2: float = np.nan
    """Area of body that half of the frames show; NaN where nobody looked."""
    beside_share: float = 0.0
    """Share of the frames in which the matte holds something beside the person."""
    outlined: float = 0.0
    """Share of the frames whose own outline said where it is."""
    background_stands: bool = False
    """Whether the background moves by no more than it seems to before a camera that stands."""

    def report(self) -> dict[str, Any]:
        """What `tracking.json` tells of the body."""
        turns = Rotation.from_matrix(self.rotation)
        away = np.degrees((turns * turns.mean().inv()).magnitude())
        return {
            "still": self.still,
            "followed_share": self.followed,
            "outlined_share": self.outlined,
            "shoulders_up_cm": self.shoulders_up_cm,
            "turned_degrees": float(np.percentile(away, 98)),
            "moved_mm": float(1e3 * np.percentile(_away(self.neck_m), 98)),
            "background_moves_px": None if np.isnan(self.background_px) else self.background_px,
            "background_stands": self.background_stands,
            "covered_share": self.covered_share,
            "seen_cm2": None if np.isnan(self.seen_cm2) else self.seen_cm2,
            "beside_share": self.beside_share,
        }


def place_body(
    body: BodyMesh,
    camera: StillCamera,
    scale: float,
    sightings: Sequence[BodySighting],
    head_neck_m: Float[np.ndarray, "F 3"],
    follows: Sequence[bool],
    shoulders: Sequence[SeenShoulders],
    path: OutlinePath | None = None,
    visited: Callable[[], None] = lambda: None,
) -> BodyPlaces:
    """The body's place in every frame; `head_neck_m` is where the heads say the neck's joint is.

    `camera` is the source's, `scale` the size of the pictures in which the body was followed by the
    source's. `follows[i]` says that frame i comes directly after frame i - 1: nothing is smoothed
    across other borders. `path` is where outlines put the body, which frames without a pattern go
    by, or with one of few points that is not the body's. `visited` is called at each of the
    `ROUNDS` visits of a frame.

    The clothes' pattern says how the body moves, or their outline, never the head's turn. What they
    do not say is where it stood: upright and turned to the camera on the whole, unless the
    shoulders say plainly otherwise, and under the head on the whole.
    """
    frames = len(sightings)
    runs, stretch = np.array([one.run for one in sightings]), np.cumsum(~np.array(follows, bool))
    rotation, neck_m = np.tile(np.eye(3), (frames, 1, 1)), head_neck_m.copy()
    still, followed = True, 0
    for run in np.unique(runs):
        own = np.flatnonzero(runs == run)
        near = [one for one in shoulders if own[0] <= one.position <= own[-1]]
        seen = [sightings[k] for k in own]
        outlined = None if path is None else path.of(own)
        motions, start, count = _Run(
            body,
            camera,
            scale,
            seen,
            head_neck_m[own],
            stretch[own],
            near,
            outlined,
            int(own[0]),
            len(own) < frames,
        ).solved(visited)
        still &= all(motion is motions[0] for motion in motions)
        followed += count
        for motion, k in zip(motions, own):
            here = motion.after(start)
            rotation[k], neck_m[k] = here.rotation, here(body.neck_m)
    moved = np.array([one.background_px for one in sightings])
    background_px = float(np.nanpercentile(moved, 98)) if np.isfinite(moved).any() else np.nan
    covered = np.mean([one.covered > _COVERED for one in sightings])
    return BodyPlaces(
        rotation,
        neck_m,
        still,
        followed / max(frames, 1),
        background_px,
        covered_share=float(covered),
        outlined=0.0 if path is None else float(path.told.mean()),
        background_stands=background_px * scale < _STANDS_PX,
    )


@dataclass(frozen=True)
class _Run:
    """Frames through which the body is followed; `first` is the position of the first one.

    `stretch` counts up where the film leaves something out between two of them.
    """

    body: BodyMesh
    camera: StillCamera
    scale: float
    sightings: Sequence[BodySighting]
    neck_m: Float[np.ndarray, "F 3"]
    stretch: Int[np.ndarray, "F"]
    shoulders: Sequence[SeenShoulders]
    path: OutlinePath | None
    first: int
    is_part: bool
    """Whether there are others, which outlines alone put in the same place."""

    def solved(self, visited: Callable[[], None]) -> tuple[list[RigidMotion], RigidMotion, int]:
        """Motions since the first frame, where the body is in that, and in how many it was found.

        How far a turn moves points follows from how deep they lie, and that from how the body
        stands in the first frame, which is known when its motion is: so it goes round.
        """
        start = RigidMotion(np.eye(3), self.neck_m[0] - self.body.neck_m)
        motions, count = [RigidMotion.none()] * len(self.sightings), 0
        along = motions if self.path is None else self.path.motions()
        for _ in range(ROUNDS):
            found = run_motions(
                self.body, self.camera, self.scale, self.sightings, start, along, visited
            )
            pivot = start(self.body.neck_m)
            found = self._relied_on(self._near_the_head(found, pivot), pivot)
            count = sum(motion is not None for motion in found)
            motions = _filled(found, along, pivot, self.stretch)
            if _extent_m(self.body, motions, pivot) < _STILL_M:
                motions = [RigidMotion.none()] * len(motions)
            else:
                motions = _smoothed(motions, pivot, self.stretch)
            turn = self._upright(motions)
            necks_m = self.neck_m
            if self.path is not None and (self.is_part or 2 * count < len(motions)):
                necks_m = self.path.neck_m
            back = [motion.undone()(place) for motion, place in zip(motions, necks_m)]
            start = RigidMotion(turn, np.median(back, axis=0) - turn @ self.body.neck_m)
        return motions, start, count

    def _relied_on(
        self, motions: Sequence[RigidMotion | None], pivot_m: Float[np.ndarray, "3"]
    ) -> list[RigidMotion | None]:
        """Motions without those of few points, where outlines say how the body moves.

        What a few of them follow over a plain shirt may be what stays where it is in the picture:
        its last rows, a film's compression. So they must tell most of what outlines do.
        """
        if self.path is None:
            return list(motions)
        told = self.path.told
        frames = zip(self.sightings, motions, self.path.motions(), told)
        # The first frame's points rest in it by definition: they tell nothing.
        both = [
            (sighting.num_seen, motion, way)
            for sighting, motion, way, tells in [*frames][1:]
            if tells and motion is not None
        ]
        if both and not self._agree(both, pivot_m):
            return [None] * len(motions)
        return [
            motion if k == 0 or sighting.is_followed or not told[k] else None
            for k, (motion, sighting) in enumerate(zip(motions, self.sightings))
        ]

    def _agree(
        self,
        both: Sequence[tuple[int, RigidMotion, RigidMotion]],
        pivot_m: Float[np.ndarray, "3"],
    ) -> bool:
        """Whether motions of so many points are the body's, as those by its outlines beside are."""
        if np.median([count for count, _, _ in both]) >= _MANY_POINTS:
            return True
        marks = _marks_m(self.body, pivot_m)
        points_px, outline_px = (
            np.array([self.camera.project(motion(marks)) for motion in way])
            for way in ([one for _, one, _ in both], [way for _, _, way in both])
        )
        px_per_m = self.camera.px_per_m(pivot_m[2])
        moved_m, apart_m = (_spread(px) / px_per_m for px in (outline_px, points_px - outline_px))
        return bool(apart_m < max(_AGREES_M, _UNEXPLAINED * moved_m))

    def _near_the_head(
        self, motions: Sequence[RigidMotion | None], pivot_m: Float[np.ndarray, "3"]
    ) -> list[RigidMotion | None]:
        """Motions without those that no body under this head makes: an arm's, a neighbour's."""
        apart = np.array(
            [
                np.full(3, np.nan) if motion is None else motion(pivot_m) - place
                for motion, place in zip(motions, self.neck_m)
            ]
        )
        if not np.isfinite(apart).any():
            return list(motions)
        off = np.linalg.norm(apart - np.nanmedian(apart, axis=0), axis=1)
        return [motion if far < _NECK_REACH_M else None for motion, far in zip(motions, off)]

    def _upright(self, motions: Sequence[RigidMotion]) -> Float[np.ndarray, "3 3"]:
        """The rotation in the first frame with which the body is upright on the whole."""
        turns = Rotation.from_matrix([motion.rotation for motion in motions])
        level = turns.mean().inv() if len(motions) >= _LEAST_FRAMES else Rotation.identity()
        tilts, yaws = [], []
        for one in self.shoulders:
            k = one.position - self.first
            turn = (turns[k] * level).as_matrix()
            marks = (self.body.shoulders_m - self.body.neck_m) @ turn.T + self.neck_m[k]
            tilts.append(_slant(self.camera.project(marks)) - _slant(one.shoulders_px))
            yaws.append(one.yaw_rad)
        yaw, roll = _plain(yaws, _DOUBTED_YAW_RAD), _plain(tilts, _DOUBTED_ROLL_RAD)
        return (level * Rotation.from_rotvec([0.0, yaw, roll])).as_matrix()


def _away(points_m: Float[np.ndarray, "F 3"]) -> Float[np.ndarray, "F"]:
    """Distances to the median point."""
    return np.linalg.norm(points_m - np.median(points_m, axis=0), axis=1)


def _marks_m(body: BodyMesh, neck_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The neck's joint, where it is, and the shoulders."""
    return np.stack([body.neck_m, *body.shoulders_m]) - body.neck_m + neck_m


def _spread(places: Float[np.ndarray, "F M d"]) -> float:
    """How far marks are from where each mostly is, root mean square."""
    away = places - np.median(places, axis=0)
    return float(np.sqrt((away**2).sum(-1).mean()))


def _filled(
    motions: Sequence[RigidMotion | None],
    along: Sequence[RigidMotion],
    pivot_m: Float[np.ndarray, "3"],
    stretch: Int[np.ndarray, "F"],
) -> list[RigidMotion]:
    """Frames without a motion go as `along` says, and evenly from what the last one that has one is
    off it to what the next is, in a stretch.

    Where a stretch has none, they are off as the nearest frame of another that has one.
    """
    pairs = [(k, one) for k, one in enumerate(motions) if one is not None]
    known = np.array([k for k, _ in pairs])
    # What the pattern says beyond the outline, about the joint where it was in the first frame.
    found = [one.after(along[k].undone()) for k, one in pairs]
    if not found:
        return list(along)
    at = np.arange(len(motions))
    for own in _stretches(stretch):
        inside = known[(known >= own[0]) & (known <= own[-1])]
        if not len(inside):
            inside = known[[np.abs(known - own.mean()).argmin()]]
        at[own] = own.clip(inside[0], inside[-1])
    turns = Rotation.from_matrix([motion.rotation for motion in found])
    between = turns if len(known) == 1 else Slerp(known, turns)(at)
    matrices = np.broadcast_to(between.as_matrix(), (len(at), 3, 3))
    # Of the joint in each frame, that turns do not carry it away.
    off_m = np.array([one(pivot_m) - along[k](pivot_m) for k, one in pairs])
    off_m = np.stack([np.interp(at, known, part) for part in off_m.T], axis=1)
    filled = []
    for turn, by_m, own in zip(matrices, off_m, along):
        place, rotation = own(pivot_m) + by_m, turn @ own.rotation
        filled.append(RigidMotion(rotation, place - rotation @ pivot_m))
    return filled


def _stretches(stretch: Int[np.ndarray, "F"]) -> list[Int[np.ndarray, "_"]]:
    """The frames of each stretch."""
    return np.split(np.arange(len(stretch)), np.flatnonzero(np.diff(stretch)) + 1)


def _extent_m(
    body: BodyMesh, motions: Sequence[RigidMotion], neck_m: Float[np.ndarray, "3"]
) -> float:
    """How far the neck's joint and the shoulders go from where they mostly are."""
    marks = _marks_m(body, neck_m)
    places = np.array([motion(marks) for motion in motions])
    away = np.linalg.norm(places - np.median(places, axis=0), axis=-1).max(1)
    return float(np.percentile(away, 98))


def _smoothed(
    motions: Sequence[RigidMotion],
    pivot: Float[np.ndarray, "3"],
    stretch: Int[np.ndarray, "F"],
) -> list[RigidMotion]:
    """Motions without what points tremble: bodies are heavy. Each stretch is smoothed by itself."""
    turns = Rotation.from_matrix([m.rotation for m in motions]).as_rotvec()
    pivots = np.array([m(pivot) for m in motions])
    for own in _stretches(stretch):
        for part in (turns, pivots):
            part[own] = gaussian_filter1d(part[own], _SMOOTH_FRAMES, axis=0, mode="nearest")
    matrices = Rotation.from_rotvec(turns).as_matrix()
    return [RigidMotion(r, p - r @ pivot) for r, p in zip(matrices, pivots)]


def _slant(pair_px: Float[np.ndarray, "2 2"]) -> float:
    """Angle of the line from the right shoulder to the left one, clockwise in the picture."""
    x, y = pair_px[0] - pair_px[1]
    return float(np.arctan2(y, x))


def _plain(angles: Sequence[float], doubt: float) -> float:
    """The median as far as it is beyond doubt."""
    if not len(angles):
        return 0.0
    middle = float(np.median(angles))
    return float(np.sign(middle) * max(0.0, abs(middle) - doubt))
