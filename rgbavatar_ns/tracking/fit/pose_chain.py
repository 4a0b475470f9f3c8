"""The joints of one pose, and what a detector's points slide with as the head moves."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.head.joints import JAW, NECK

NUM_SIGNALS = 8
"""The view's five terms, the jaw, the eyes' pitch and yaw."""
_NO_ANGLE_RAD = 1e-7
_EYE = np.eye(3)
# Row y holds the matrix of the cross product with axis y, flat.
_AXES_CROSS = np.cross(_EYE[:, None], _EYE[None]).transpose(0, 2, 1).reshape(3, 9)


@dataclass(frozen=True)
class PoseChain:
    """Joints of a pose: what rests at x on joint j goes to turned_j (x - at_rest_j) + placed_j.

    `local` are the joints' own rotations, of `axis_angles`; `above` are those of their parents in
    the world, so that turned_j = above_j local_j.
    """

    axis_angles: Float[np.ndarray, "5 3"]
    local: Float[np.ndarray, "5 3 3"]
    above: Float[np.ndarray, "5 3 3"]
    turned: Float[np.ndarray, "5 3 3"]
    at_rest: Float[np.ndarray, "5 3"]
    placed: Float[np.ndarray, "5 3"]

    @property
    def features(self) -> Float[np.ndarray, "36"]:
        """R - I of all joints but the root, FLAME's order."""
        return (self.local[1:] - _EYE).reshape(36)

    def local_spins(self) -> Float[np.ndarray, "5 3 3"]:
        """Column k: angular velocity in the parent's frame as entry k of the axis angle grows."""
        return angular_velocities(self.axis_angles, self.local)


@dataclass(frozen=True)
class PoseView:
    """A pose's joints and what a detector's response depends on: `signals` [8]."""

    chain: PoseChain
    towards: Float[np.ndarray, "3"]
    """From the skull to the camera, in the world, length 1."""
    cosines: Float[np.ndarray, "3 2"]
    """Of the first two angles of jaw and eyes."""
    signals: Float[np.ndarray, "8"]


def signal_slopes(
    view: PoseView,
    joints: Int[np.ndarray, "A"],
    axes: Int[np.ndarray, "A"],
    spins: Float[np.ndarray, "A 3"],
) -> Float[np.ndarray, "8 A"]:
    """Derivative of the signals to entries of joints' axis angles.

    `spins` are the angular velocities in the world as these entries grow.
    """
    slopes = np.zeros((NUM_SIGNALS, len(joints)))
    # The direction to the camera turns the other way, as the skull sees it.
    seen = -(spins @ cross_matrices(view.towards)) @ view.chain.turned[NECK]
    dx, dy = np.where(joints <= NECK, seen[:, :2].T, 0.0)
    x, y = view.signals[:2]
    slopes[:5] = dx, dy, 2 * x * dx, 2 * y * dy, x * dy + y * dx
    for place, (joint, axis) in enumerate(zip(joints.tolist(), axes.tolist())):
        if joint == JAW and axis == 0:
            slopes[5, place] = view.cosines[0, 0]
        elif joint > JAW and axis < 2:
            slopes[6 + axis, place] = 0.5 * view.cosines[joint - JAW, axis]
    return slopes


def cross_matrices(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """The matrices whose product with v is the vector x v."""
    return (vectors @ _AXES_CROSS).reshape(*vectors.shape, 3)


def rotation_matrices(axis_angles: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3 3"]:
    """Rodrigues' formula; `head.rotations` has it for torch, which takes longer for five joints."""
    angles = np.sqrt(np.square(axis_angles).sum(1))[:, None, None]
    cross = cross_matrices(axis_angles)
    # sin(a) / a and (1 - cos(a)) / a^2, without dividing by 0.
    first, half = np.sinc(angles / np.pi), np.sinc(angles / (2 * np.pi))
    return _EYE + first * cross + 0.5 * half**2 * (cross @ cross)


def angular_velocities(
    axis_angles: Float[np.ndarray, "J 3"], rotations: Float[np.ndarray, "J 3 3"]
) -> Float[np.ndarray, "J 3 3"]:
    """Column k: angular velocity of exp(v) as v's entry k grows (Gallego and Yezzi 2015)."""
    squared = np.square(axis_angles).sum(1)[:, None, None]
    none = squared < _NO_ANGLE_RAD**2
    across = cross_matrices(axis_angles) @ (_EYE - rotations)
    own = axis_angles[:, :, None] * axis_angles[:, None]
    return np.where(none, _EYE, (own + across) / np.where(none, 1.0, squared))
