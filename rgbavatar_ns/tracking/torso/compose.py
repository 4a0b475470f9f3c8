"""Theta of a body with a head on it, out of the theta of a head alone."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rgbavatar_ns.head import HeadArrays, ThetaLayout
from rgbavatar_ns.head.arrays import BODY_IDENTITY, NECK_SHIFTS
from rgbavatar_ns.head.joints import NECK
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead
from rgbavatar_ns.tracking.fit.pose_chain import PoseChain
from rgbavatar_ns.tracking.torso.place import BodyPlaces

_FARTHEST = 3.0
"""Farther than so many centimetres no neck carries the head without a turn: then the body is
elsewhere than it was found."""


def on_body(
    head: LandmarkHead,
    arrays: HeadArrays,
    identity: Float[np.ndarray, "I"],
    theta: Float[np.ndarray, "F H"],
    places: BodyPlaces,
) -> tuple[Float[np.ndarray, "I"], Float[np.ndarray, "F H"]]:
    """The person, and the same heads upon a body: the root carries the body, the neck the head.

    Every point that the neck carries wholly stays exactly where it was: the neck's turn is what
    the body's leaves, and its shifts what is left between the joint's two places. Beyond three
    centimetres the body follows. The person's shoulders are as high as they were found.
    """
    layout: ThetaLayout = head.layout
    rotation, neck, translation = (layout.slice(n) for n in ("rotation", "neck", "translation"))
    first = layout.slice("expression").start
    columns = [first + arrays.expression_names.index(name) for name in NECK_SHIFTS]
    carried_m, joint_m = _shift_per_unit(arrays)
    person = identity.copy()
    person[arrays.num_identity - len(BODY_IDENTITY)] = places.shoulders_up_cm
    result = theta.copy()
    for row, body, place in zip(result, places.rotation, places.neck_m):
        chain = head.chain(row, identity)
        skull = chain.turned[NECK]
        # skull (x + C c - j - J c) + place + body J c = skull (x - j) + where the joint is
        along = skull @ (carried_m - joint_m) + body @ joint_m
        shift = np.linalg.solve(along, chain.placed[NECK] - place).clip(-_FARTHEST, _FARTHEST)
        row[columns] = shift
        row[rotation] = Rotation.from_matrix(body).as_rotvec()
        row[neck] = Rotation.from_matrix(body.T @ skull).as_rotvec()
        row[translation] = 0.0
        moved = _skull_origin(head.chain(row, person)) + skull @ carried_m @ shift
        row[translation] = _skull_origin(chain) - moved
    return person, result


def _skull_origin(chain: PoseChain) -> Float[np.ndarray, "3"]:
    """Where a pose puts what rests at the origin and follows the neck."""
    return chain.placed[NECK] - chain.turned[NECK] @ chain.at_rest[NECK]


def _shift_per_unit(
    arrays: HeadArrays,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """How a unit of each neck shift (columns) moves the skull, and the neck's joint, metres."""
    columns = [arrays.num_identity + arrays.expression_names.index(name) for name in NECK_SHIFTS]
    moved = arrays.shapedirs[..., columns].astype(np.float64)
    skull = moved[arrays.vertex_groups["upper_teeth"]].mean(0)
    return skull, np.tensordot(arrays.joint_regressor[NECK].astype(np.float64), moved, axes=1)
