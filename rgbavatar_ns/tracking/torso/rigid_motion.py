"""How a rigid body moved, from where its points are seen."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.pose_chain import cross_matrices, rotation_matrices

_Points = Float[np.ndarray, "P 3"]

_ITERATIONS = 8
# A step this small, radians and metres, is a fraction of what the points' own noise moves.
_SETTLED = 1e-4
# Points this far off (a sleeve that folds, a hand) hardly count: Geman and McClure's loss. Pixels
# of the picture in which they are followed: a larger film is not followed more exactly.
_ROBUST_PX = 0.7
# A frame's motion is drawn to the one before it by so much, so that few or flat points do not let
# it wander: standard deviations from frame to frame.
_TURN_RAD, _SHIFT_M = 0.05, 0.02
_LEAST_POINTS = 8


@dataclass(frozen=True)
class RigidMotion:
    """x goes to rotation x + shift_m; in the world."""

    rotation: Float[np.ndarray, "3 3"]
    shift_m: Float[np.ndarray, "3"]

    @classmethod
    def none(cls) -> "RigidMotion":
        """Everything stays."""
        return cls(np.eye(3), np.zeros(3))

    def __call__(self, points_m: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points moved."""
        return points_m @ self.rotation.T + self.shift_m

    def after(self, first: "RigidMotion") -> "RigidMotion":
        """`first`, then this."""
        return RigidMotion(self.rotation @ first.rotation, self(first.shift_m))

    def undone(self) -> "RigidMotion":
        """The way back."""
        return RigidMotion(self.rotation.T, -self.rotation.T @ self.shift_m)


def fit_rigid_motion(
    points_m: _Points,
    seen_px: Float[np.ndarray, "P 2"],
    certainty: Float[np.ndarray, "P 2 2"],
    camera: StillCamera,
    scale: float,
    before: RigidMotion,
    pivot_m: Float[np.ndarray, "3"],
) -> tuple[RigidMotion, float] | None:
    """The motion that carries points to where they are seen, near `before`, and its error.

    `seen_px` and the error, the median distance, are in pixels of `camera`'s picture; `scale` is
    the size of the picture in which the points were followed by that one's. `certainty` says along
    which directions of the picture a place counts. Turns are drawn to those of `before` about
    `pivot_m`. None where too few points agree.
    """
    if len(points_m) < _LEAST_POINTS:
        return None
    sigma_px = _ROBUST_PX / scale
    motion = before
    turned, shifted = np.zeros(3), np.zeros(3)
    pivot = before(pivot_m)
    precision = np.repeat([_TURN_RAD**-2.0, _SHIFT_M**-2.0], 3)
    # By turn and shift: the shift's part stays.
    moved = np.tile(np.eye(3, 6, 3), (len(points_m), 1, 1))
    for _ in range(_ITERATIONS):
        places = motion(points_m)
        away = (camera.project(places) - seen_px) / sigma_px
        counted = (certainty @ away[..., None])[..., 0]
        weight = 1 / (1 + (counted * away).sum(1).clip(0)) ** 2
        moved[..., :3] = -cross_matrices(places - (pivot + shifted))
        rows = camera.image_slope(places) / sigma_px @ moved
        known = (certainty @ rows).reshape(-1, 6)
        weighted = (rows * weight[:, None, None]).reshape(-1, 6)
        hessian = weighted.T @ known + np.diag(precision)
        gradient = weighted.T @ counted.reshape(-1)
        gradient += precision * np.concatenate([turned, shifted])
        step = -np.linalg.solve(hessian, gradient)
        turned, shifted = turned + step[:3], shifted + step[3:]
        turn = rotation_matrices(turned[None])[0]
        motion = RigidMotion(turn, pivot + shifted - turn @ pivot).after(before)
        if np.abs(step).max() < _SETTLED:
            break
    away = camera.project(motion(points_m)) - seen_px
    away = np.sqrt((away * (certainty @ away[..., None])[..., 0]).sum(1).clip(0))
    if np.count_nonzero(away < 2 * sigma_px) < max(_LEAST_POINTS, 0.3 * len(away)):
        return None
    return motion, float(np.median(away))
