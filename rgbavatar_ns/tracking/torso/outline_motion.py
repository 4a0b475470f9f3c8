"""How a body moves by its outline alone: what a plain shirt still tells."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion

# What is looked at, around the neck's joint: to each side, from just above it down to the chest.
_ASIDE_M, _ABOVE_M, _BELOW_M, _CELL_M = 0.36, 0.02, 0.30, 0.01
# Jaw and neck, which turn with the head.
_JAW_ASIDE_M, _JAW_BELOW_M = 0.1, 0.04
_UNSEEN = 255
# Blurs, in cells: from afar first, then exactly.
_BLURS, _STEPS = (4.0, 1.2), (4, 4)
# What alpha errs by, neighbouring cells together; what is off by far more (hair, a hand) hardly
# counts.
_NOISE, _TOGETHER, _ROBUST = 0.1, 0.15, 0.2
# Before anything is seen: sideways and up, metres; the logarithm of its size; its tilt, radians.
_WIDTHS = np.array([0.04, 0.05, 0.04, 0.06])
# A frame whose outline leaves sideways or up less sure than so tells nothing.
_SURE_M = 0.02
_ROUNDS, _MOST_LEARNT = 3, 200
# A body whose outline moves by less keeps still: it is heavier than its matte is steady.
_STILL_M = 0.006
# Frames within which a body goes evenly, whatever its head does.
_SOON_FRAMES = 12
_SHOULDER_M = 0.18


@dataclass(frozen=True)
class OutlinePatch:
    """The person's alpha around the neck's joint of one frame, as large as the head says."""

    position: int
    alpha: UInt8[np.ndarray, "rows columns"]
    """0 to 254; 255 where the picture shows nothing."""


@dataclass(frozen=True)
class OutlinePath:
    """Where outlines put the neck's joint and how they tilt the body, in each of F frames."""

    neck_m: Float[np.ndarray, "F 3"]
    roll_rad: Float[np.ndarray, "F"]
    told: Bool[np.ndarray, "F"]
    """Where a frame's own outline says so; else it is between those that do, or as the head."""

    def of(self, frames: Int[np.ndarray, "R"]) -> "OutlinePath":
        """The same of some frames."""
        return OutlinePath(self.neck_m[frames], self.roll_rad[frames], self.told[frames])

    def motions(self) -> list[RigidMotion]:
        """How the body moves from the first frame to each."""
        found = []
        for roll, place in zip(self.roll_rad - self.roll_rad[0], self.neck_m):
            turn = np.eye(3)
            turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
            found.append(RigidMotion(turn, place - turn @ self.neck_m[0]))
        return found


def outline_patch(
    position: int,
    matte: Float[np.ndarray, "h w"],
    neck_m: Float[np.ndarray, "3"],
    camera: StillCamera,
) -> OutlinePatch:
    """What the matte shows around the neck's joint; the camera is the matte's."""
    cells_m = _cells_m()
    px_per_m = camera.px_per_m(neck_m[2])
    px = (camera.project(neck_m) + px_per_m * cells_m * (1, -1)).astype(np.float32)
    fine = cv2.GaussianBlur(matte, (0, 0), max(0.4 * _CELL_M * px_per_m, 0.3))
    alpha = cv2.remap(fine, px[..., 0], px[..., 1], cv2.INTER_LINEAR)
    height, width = matte.shape
    # The picture's last rows and columns are where a matte has no outline of its own.
    shown = ((px >= 1) & (px <= (width - 2, height - 2))).all(-1)
    shown &= (np.abs(cells_m[..., 0]) > _JAW_ASIDE_M) | (cells_m[..., 1] < -_JAW_BELOW_M)
    levels = np.round(alpha.clip(0, 1) * (_UNSEEN - 1)).astype(np.uint8)
    return OutlinePatch(position, np.where(shown, levels, np.uint8(_UNSEEN)))


def outline_path(
    patches: Sequence[OutlinePatch],
    neck_m: Float[np.ndarray, "F 3"],
    camera: StillCamera,
    follows: Sequence[bool],
    visited: Callable[[], None] = lambda: None,
) -> OutlinePath | None:
    """The body's path by its outlines, on the whole under its head; None where they tell nothing.

    What all patches have in common is laid over each, moved, grown and tilted, to its head's depth
    and upright as far as it says nothing else. `follows[i]` says that frame i comes directly after
    frame i - 1; in what does so a body whose outline hardly moves keeps still, and frames that do
    not tell lie between those that do, or go with the head where they are many. `visited` is called
    at each of `num_visits`. Ours, because plain shirts have no pattern to follow, and clothes that
    were taken to keep still were torn.
    """
    if not patches:
        return None
    places, sure = _laid_over_all(patches, visited)
    at = np.array([patch.position for patch in patches])[sure]
    if not len(at):
        return None
    right, up, size, roll_rad = places[sure].T
    depth_m = camera.distance_m - neck_m[at, 2]
    own_m = depth_m * np.exp(-size)
    # As far from the picture's middle as the outline is, at the depth that its size tells.
    across = (neck_m[at, :2] + np.stack([right, up], 1)) * (own_m / depth_m)[:, None]
    seen_m = np.concatenate([across, camera.distance_m - own_m[:, None]], 1)
    frames, stretch = np.arange(len(neck_m)), np.cumsum(~np.array(follows, bool))
    found_m, found_rad = neck_m.copy(), np.zeros(len(neck_m))
    for own in np.unique(stretch):
        here, inside = frames[stretch == own], stretch[at] == own
        if not inside.any():  # as where nothing is seen at all
            found_m[here] = np.median(neck_m[here], axis=0)
            continue
        known = np.column_stack([seen_m, roll_rad])[inside]
        if _extent_m(known, camera) < _STILL_M:
            found_m[here] = np.median(known[:, :3], axis=0)
            continue
        found_m[here] = _between(here, at[inside], known[:, :3], neck_m)
        found_rad[here] = np.interp(here, at[inside], known[:, 3])
    return OutlinePath(found_m, found_rad, np.isin(frames, at))


def _between(
    frames: Int[np.ndarray, "R"],
    at: Int[np.ndarray, "K"],
    known_m: Float[np.ndarray, "K 3"],
    neck_m: Float[np.ndarray, "F 3"],
) -> Float[np.ndarray, "R 3"]:
    """The joint's places, known in some frames, in all of them: evenly from one to the next.

    Where that takes longer, and before the first and after the last, it goes with the head.
    """
    beside_m = known_m - neck_m[at]
    evenly, beside = (
        np.stack([np.interp(frames, at, part) for part in parts.T], 1)
        for parts in (known_m, beside_m)
    )
    after = np.searchsorted(at, frames)
    ends = (after == 0) & (frames < at[0]) | (after == len(at))
    apart = at[after.clip(0, len(at) - 1)] - at[(after - 1).clip(0)]
    alone = ends | (apart > _SOON_FRAMES) & ~np.isin(frames, at)
    return np.where(alone[:, None], neck_m[frames] + beside, evenly)


def num_visits(patches: int) -> int:
    """How often `outline_path` looks at one of so many patches."""
    return patches + _ROUNDS * min(patches, _MOST_LEARNT)


def _laid_over_all(
    patches: Sequence[OutlinePatch], visited: Callable[[], None]
) -> tuple[Float[np.ndarray, "P 4"], Bool[np.ndarray, "P"]]:
    """Where what they have in common lies in each, about their median, and which tell it."""
    few = min(len(patches), _MOST_LEARNT)
    chosen = np.unique(np.linspace(0, len(patches) - 1, few).round().astype(int))
    places, sure = np.zeros((len(patches), 4)), np.zeros(len(patches), bool)
    common = _Common.of([_known(patches[k]) for k in chosen])
    for number in range(_ROUNDS):
        for k in chosen:
            places[k], sure[k] = _laid_over(patches[k], common, places[k])
            visited()
        told = chosen[sure[chosen]]
        if not len(told):  # what is left to be visited tells no more
            for _ in range(len(chosen) * (_ROUNDS - 1 - number) + len(patches)):
                visited()
            return places, sure
        places -= np.median(places[told], axis=0)
        common = _Common.of([_moved(patches[k], places[k]) for k in told])
    last = np.zeros(4)
    for k, patch in enumerate(patches):
        found, sure[k] = _laid_over(patch, common, last)
        places[k] = last = found if sure[k] else last
        visited()
    return places, sure


def _cells_m() -> Float[np.ndarray, "rows columns 2"]:
    """Right of and above the neck's joint."""
    x = np.arange(-_ASIDE_M, _ASIDE_M + _CELL_M / 2, _CELL_M)
    y = np.arange(_ABOVE_M, -_BELOW_M - _CELL_M / 2, -_CELL_M)
    return np.stack(np.meshgrid(x, y), -1)


@dataclass(frozen=True)
class _Common:
    """What patches have in common: alpha at each blur, and where it is known."""

    layers: Sequence[Float[np.ndarray, "rows columns"]]
    known: Bool[np.ndarray, "rows columns"]

    @classmethod
    def of(cls, alphas: Sequence[Float[np.ndarray, "rows columns"]]) -> "_Common":
        """The median of what is known of each cell."""
        stacked = np.array(alphas)
        known = np.isfinite(stacked).any(0)
        stacked[:, ~known] = 0.0
        middle = np.nanmedian(stacked, axis=0)
        return cls([_blurred(middle, known, sigma) for sigma in _BLURS], known)


def _known(patch: OutlinePatch) -> Float[np.ndarray, "rows columns"]:
    """Alpha, NaN where nothing is seen."""
    return np.where(patch.alpha == _UNSEEN, np.nan, patch.alpha / (_UNSEEN - 1))


def _places(place: Float[np.ndarray, "4"]) -> Float[np.ndarray, "rows columns 2"]:
    """Where the common outline's cells lie in a frame's patch, in metres."""
    right, up, size, roll = place
    turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    return np.exp(size) * _cells_m() @ turn.T + (right, up)


def _at(
    values: Float[np.ndarray, "rows columns *c"], places_m: Float[np.ndarray, "rows columns 2"]
) -> Float[np.ndarray, "rows columns *c"]:
    """Values of a patch at places; -1 beyond it."""
    column = ((places_m[..., 0] + _ASIDE_M) / _CELL_M).astype(np.float32)
    row = ((_ABOVE_M - places_m[..., 1]) / _CELL_M).astype(np.float32)
    border = (-1.0, -1.0, -1.0, -1.0)
    return cv2.remap(values, column, row, cv2.INTER_LINEAR, borderValue=border)


def _moved(patch: OutlinePatch, place: Float[np.ndarray, "4"]) -> Float[np.ndarray, "rows columns"]:
    """A patch as the common outline has it, NaN where it shows nothing."""
    known = _known(patch)
    shown = _at(np.isfinite(known).astype(np.float32), _places(place)) > 0.99
    return np.where(shown, _at(np.nan_to_num(known).astype(np.float32), _places(place)), np.nan)


def _laid_over(
    patch: OutlinePatch, common: _Common, start: Float[np.ndarray, "4"]
) -> tuple[Float[np.ndarray, "4"], bool]:
    """Right, up, logarithm of the size, and tilt with which the common outline lies on a patch,
    and whether the patch tells its place."""
    place, hessian = start.copy(), np.diag(_WIDTHS**-2.0)
    known = _known(patch)
    shown = np.isfinite(known)
    for sigma, steps, wanted in zip(_BLURS, _STEPS, common.layers):
        image = _blurred(np.nan_to_num(known), shown, sigma)
        rows, columns = np.gradient(image, _CELL_M)
        layers = np.dstack([image, columns, -rows, shown]).astype(np.float32)
        for _ in range(steps):
            value, across, along, seen = np.moveaxis(_at(layers, _places(place)), -1, 0)
            counts = (seen > 0.99) & common.known
            off = np.where(counts, value - wanted, 0.0)
            x, y = np.moveaxis(_places(place) - place[:2], -1, 0)
            slopes = np.stack([across, along, across * x + along * y, along * x - across * y], -1)
            weight = counts * _TOGETHER / (_NOISE * (1 + (off / _ROBUST) ** 2)) ** 2
            weighted = slopes * weight[..., None]
            hessian = np.einsum("rci,rcj->ij", weighted, slopes) + np.diag(_WIDTHS**-2.0)
            gradient = np.einsum("rci,rc->i", weighted, off) + place / _WIDTHS**2
            place = place - np.linalg.solve(hessian, gradient)
            place = place.clip(-3 * _WIDTHS, 3 * _WIDTHS)
    unsure = np.sqrt(np.diag(np.linalg.inv(hessian))[:2]).max()
    return place, bool(unsure < _SURE_M)


def _blurred(
    values: Float[np.ndarray, "rows columns"],
    known: Bool[np.ndarray, "rows columns"],
    sigma: float,
) -> Float[np.ndarray, "rows columns"]:
    """A blur among what is known alone."""
    both = cv2.GaussianBlur(np.dstack([values * known, known]).astype(np.float32), (0, 0), sigma)
    return both[..., 0] / both[..., 1].clip(1e-3)


def _extent_m(known: Float[np.ndarray, "K 4"], camera: StillCamera) -> float:
    """How far the joint and both shoulders go in the picture from where they mostly are, for its
    places, in metres, and tilts."""
    neck_m, tilt = known[:, :3], known[:, 3]
    across = np.stack([np.cos(tilt), np.sin(tilt), np.zeros(len(tilt))], 1)
    marks = [camera.project(neck_m + side * _SHOULDER_M * across) for side in (-1, 0, 1)]
    px_per_m = camera.px_per_m(float(np.median(neck_m[:, 2])))
    away = [np.linalg.norm(px - np.median(px, axis=0), axis=1) / px_per_m for px in marks]
    return float(np.percentile(np.max(away, axis=0), 98))
