"""The joints of one pose, and what a detector's points slide with as the head moves."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

ROOT, SKULL, JAW = 0, 1, 2
NUM_SIGNALS = 8
"""The view's five terms, the jaw, the eyes' pitch and yaw."""
_NO_ANGLE_RAD = 1e-7


@dataclass(frozen=True)
class PoseChain:
    """Joints of a pose: what rests at x on joint j goes to turned_j (x - at_rest_j) + placed_j.

    `local` are the joints' own rotations; column k of `spin` is the angular velocity in the world
    as entry k of the joint's axis angle grows.
    """

    local: Float[np.ndarray, "5 3 3"]
    turned: Float[np.ndarray, "5 3 3"]
    spin: Float[np.ndarray, "5 3 3"]
    at_rest: Float[np.ndarray, "5 3"]
    placed: Float[np.ndarray, "5 3"]

    @property
    def features(self) -> Float[np.ndarray, "36"]:
        """R - I of all joints but the root, FLAME's order."""
        return (self.local[1:] - np.eye(3)).reshape(36)


@dataclass(frozen=True)
class PoseView:
    """A pose's joints and what a detector's response depends on: `signals` [8]."""

    chain: PoseChain
    towards: Float[np.ndarray, "3"]
    """From the skull to the camera, in the world, length 1."""
    cosines: Float[np.ndarray, "3 2"]
    """Of the first two angles of jaw and eyes."""
    signals: Float[np.ndarray, "8"]


def signal_slope(view: PoseView, joint: int, axis: int) -> Float[np.ndarray, "8"]:
    """Derivative of the signals to one entry of a joint's axis angle."""
    slope = np.zeros(NUM_SIGNALS)
    if joint <= SKULL:
        spin = view.chain.spin[joint, :, axis]
        dx, dy, _ = -view.chain.turned[SKULL].T @ np.cross(spin, view.towards)
        x, y = view.signals[:2]
        slope[:5] = dx, dy, 2 * x * dx, 2 * y * dy, x * dy + y * dx
    elif joint == JAW and axis == 0:
        slope[5] = view.cosines[0, 0]
    elif joint > JAW and axis < 2:
        slope[6 + axis] = 0.5 * view.cosines[joint - JAW, axis]
    return slope


def cross_matrix(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The matrix whose product with v is `vector` x v."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def rotation_matrices(axis_angles: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3 3"]:
    """Rodrigues' formula; `head.rotations` has it for torch, which takes longer for five joints."""
    angles = np.linalg.norm(axis_angles, axis=1)[:, None, None]
    cross = np.stack([cross_matrix(vector) for vector in axis_angles])
    # sin(a) / a and (1 - cos(a)) / a^2, without dividing by 0.
    first, half = np.sinc(angles / np.pi), np.sinc(angles / (2 * np.pi))
    return np.eye(3) + first * cross + 0.5 * half**2 * (cross @ cross)


def angular_velocities(
    axis_angle: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    """Column k: angular velocity of exp(v) as v's entry k grows (Gallego and Yezzi 2015)."""
    squared = float(axis_angle @ axis_angle)
    if squared < _NO_ANGLE_RAD**2:
        return np.eye(3)
    across = cross_matrix(axis_angle) @ (np.eye(3) - rotation)
    return (np.outer(axis_angle, axis_angle) + across) / squared
