"""The head model reduced to its landmarks: exact, and small enough for many fits a second."""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix

POSE_FIELDS = ("rotation", "neck", "jaw", "left_eye", "right_eye")
_DIFFERENCE = 1e-5


@dataclass(frozen=True)
class LandmarkJacobian:
    """Landmarks [L, 3] in metres with their derivatives to theta [L, 3, H] and identity."""

    points: Float[np.ndarray, "L 3"]
    to_theta: Float[np.ndarray, "L 3 H"]
    to_identity: Float[np.ndarray, "L 3 I"]


@dataclass(frozen=True)
class _Chain:
    """Joints of B poses: a point at rest x on joint j goes to turned_j x + sum_k carried_jk J_k.

    J are the joints at rest; `features` are R - I of all joints but the root, FLAME's order.
    """

    turned: Float[np.ndarray, "B 5 3 3"]
    carried: Float[np.ndarray, "B 5 5 3 3"]
    features: Float[np.ndarray, "B 36"]


@dataclass(frozen=True)
class _JointMoments:
    """What one joint carries: `rows` are the landmarks with any weight on it.

    share [R] sums barycentric * skinning weight; rest [3, R], dirs [3, R, C] and pose_dirs
    [3, R, 36] are the positions' and offsets' sums with the same weights.
    """

    joint: int
    rows: Int[np.ndarray, "R"]
    share: Float[np.ndarray, "R"]
    rest: Float[np.ndarray, "3 R"]
    dirs: Float[np.ndarray, "3 R C"]
    pose_dirs: Float[np.ndarray, "3 R 36"] | None


def _joint_moments(
    joint: int,
    shares: Float[np.ndarray, "L 3"],
    vertex_ids: Int[np.ndarray, "L 3"],
    template: Float[np.ndarray, "V 3"],
    dirs: Float[np.ndarray, "V 3 C"],
    pose_dirs: Float[np.ndarray, "V 3 36"],
) -> _JointMoments:
    rows = np.flatnonzero(np.any(shares, axis=1))
    corners, weights = vertex_ids[rows], shares[rows]
    posed = np.einsum("rk,rkxp->xrp", weights, pose_dirs[corners].astype(np.float64))
    return _JointMoments(
        joint,
        rows,
        weights.sum(1),
        np.einsum("rk,rkx->xr", weights, template[corners]),
        np.einsum("rk,rkxc->xrc", weights, dirs[corners]),
        posed if np.any(posed) else None,
    )


class LandmarkHead:
    """Points at barycentric places of the head's triangles as functions of theta and identity.

    Skinning is linear in the rest positions, so each landmark needs only its skinning-weighted
    moments per joint: sum over its three vertices of barycentric * weight * position. That equals
    the full `HeadModel` at these points (a test compares them). float64 numpy throughout.
    """

    def __init__(
        self,
        head: HeadModel,
        vertex_ids: Int[np.ndarray, "L 3"],
        barycentric: Float[np.ndarray, "L 3"],
    ) -> None:
        arrays = head.arrays
        self.layout = head.layout
        self.num_identity = arrays.num_identity
        self.num_landmarks = len(vertex_ids)
        shares = barycentric[..., None] * arrays.skinning_weights[vertex_ids].astype(np.float64)
        template = arrays.v_template.astype(np.float64)
        shape_dirs = arrays.shapedirs.astype(np.float64)
        lids = np.zeros((len(template), 3, 0)) if arrays.eyelid_dirs is None else arrays.eyelid_dirs
        dirs = np.concatenate([shape_dirs, lids], axis=2)
        self._moments = [
            _joint_moments(joint, shares[..., joint], vertex_ids, template, dirs, arrays.posedirs)
            for joint in range(5)
            if np.any(shares[..., joint])
        ]
        regressor = arrays.joint_regressor.astype(np.float64)
        self._joint_rest = regressor @ template
        # Eyelids shift no joint.
        joint_dirs = np.tensordot(regressor, shape_dirs, axes=1)
        self._joint_dirs = np.concatenate([joint_dirs, np.zeros((5, *lids.shape[1:]))], axis=2)
        self._parents = [int(parent) for parent in arrays.parents]

    def of_person(self, identity: Float[np.ndarray, "I"]) -> "LandmarkHead":
        """The same head with this identity folded in: smaller, and its identity has size 0."""
        count = self.num_identity
        person = copy(self)
        person.num_identity = 0
        person._moments = [
            replace(
                part,
                rest=part.rest + part.dirs[..., :count] @ identity,
                dirs=np.ascontiguousarray(part.dirs[..., count:]),
            )
            for part in self._moments
        ]
        person._joint_rest = self._joint_rest + self._joint_dirs[..., :count] @ identity
        person._joint_dirs = np.ascontiguousarray(self._joint_dirs[..., count:])
        return person

    def with_offsets(self, offsets_m: Float[np.ndarray, "L 3"]) -> "LandmarkHead":
        """Every landmark moved at rest; skinning carries the offsets along."""
        moved = copy(self)
        moved._moments = [
            replace(part, rest=part.rest + (part.share[:, None] * offsets_m[part.rows]).T)
            for part in self._moments
        ]
        return moved

    def expression_size_m(self) -> Float[np.ndarray, "E"]:
        """How far each expression at 1 moves the landmark that it moves most."""
        first = self.num_identity
        count = self.layout.slice("expression").stop - self.layout.slice("expression").start
        moved = np.zeros((3, self.num_landmarks, count))
        for part in self._moments:
            moved[:, part.rows] += part.dirs[..., first : first + count]
        return np.linalg.norm(moved, axis=0).max(0)

    def points(
        self, theta: Float[np.ndarray, "H"], identity: Float[np.ndarray, "I"]
    ) -> Float[np.ndarray, "L 3"]:
        """Landmarks in world space, metres."""
        coefficients = self._coefficients(theta, identity)
        chain = self._chain(self._poses(theta)[None])
        return self._pose(chain, coefficients)[0] + self._translation(theta)

    def head_rotation(self, theta: Float[np.ndarray, "H"]) -> Float[np.ndarray, "3 3"]:
        """World rotation of the skull: global rotation, then neck."""
        return self._chain(self._poses(theta)[None]).turned[0, 1]

    def jacobian(
        self, theta: Float[np.ndarray, "H"], identity: Float[np.ndarray, "I"]
    ) -> LandmarkJacobian:
        """Landmarks with derivatives: exact for coefficients, central differences for angles.

        The differences are taken in float64 with a step of 1e-5 rad: right to about 1e-10.
        """
        coefficients = self._coefficients(theta, identity)
        poses = self._poses(theta)
        shifts = np.eye(15).reshape(15, 5, 3) * _DIFFERENCE
        chain = self._chain(np.concatenate([poses[None], poses + shifts, poses - shifts]))
        posed = self._pose(chain, coefficients)
        to_angles = ((posed[1:16] - posed[16:]) / (2 * _DIFFERENCE)).transpose(1, 2, 0)
        to_coefficients = self._coefficient_jacobian(chain)
        to_theta = np.zeros((self.num_landmarks, 3, self.layout.size))
        for number, name in enumerate(POSE_FIELDS):
            if name in self.layout:
                to_theta[..., self.layout.slice(name)] = to_angles[..., 3 * number : 3 * number + 3]
        to_theta[..., self.layout.slice("translation")] = np.eye(3)
        expression = self.layout.slice("expression")
        count = self.num_identity + (expression.stop - expression.start)
        to_theta[..., expression] = to_coefficients[..., self.num_identity : count]
        if "eyelids" in self.layout:
            to_theta[..., self.layout.slice("eyelids")] = to_coefficients[..., count:]
        return LandmarkJacobian(
            posed[0] + self._translation(theta),
            to_theta,
            to_coefficients[..., : self.num_identity],
        )

    def _coefficients(
        self, theta: Float[np.ndarray, "H"], identity: Float[np.ndarray, "I"]
    ) -> Float[np.ndarray, "C"]:
        parts = [identity, theta[self.layout.slice("expression")]]
        if "eyelids" in self.layout:
            parts.append(theta[self.layout.slice("eyelids")])
        return np.concatenate(parts)

    def _poses(self, theta: Float[np.ndarray, "H"]) -> Float[np.ndarray, "5 3"]:
        return np.stack(
            [
                theta[self.layout.slice(name)] if name in self.layout else np.zeros(3)
                for name in POSE_FIELDS
            ]
        )

    def _translation(self, theta: Float[np.ndarray, "H"]) -> Float[np.ndarray, "3"]:
        return theta[self.layout.slice("translation")]

    def _pose(
        self, chain: _Chain, coefficients: Float[np.ndarray, "C"]
    ) -> Float[np.ndarray, "B L 3"]:
        joints = self._joint_rest + self._joint_dirs @ coefficients
        offsets = np.tensordot(chain.carried, joints, axes=((2, 4), (0, 1)))
        posed = np.zeros((len(offsets), 3, self.num_landmarks))
        for part in self._moments:
            rest = part.rest + part.dirs @ coefficients
            if part.pose_dirs is not None:
                rest = rest + np.moveaxis(part.pose_dirs @ chain.features.T, -1, 0)
            posed[..., part.rows] += chain.turned[:, part.joint] @ rest
            posed[..., part.rows] += offsets[:, part.joint, :, None] * part.share
        return posed.transpose(0, 2, 1)

    def _coefficient_jacobian(self, chain: _Chain) -> Float[np.ndarray, "L 3 C"]:
        """Of the chain's first pose."""
        offsets = np.einsum("jkxy,kyc->jxc", chain.carried[0], self._joint_dirs)
        moved = np.zeros((3, self.num_landmarks, self._joint_dirs.shape[-1]))
        for part in self._moments:
            turned = chain.turned[0, part.joint] @ part.dirs.reshape(3, -1)
            moved[:, part.rows] += turned.reshape(part.dirs.shape)
            moved[:, part.rows] += part.share[:, None] * offsets[part.joint][:, None]
        return moved.transpose(1, 0, 2)

    def _chain(self, poses: Float[np.ndarray, "B 5 3"]) -> _Chain:
        rotations = axis_angle_to_matrix(torch.from_numpy(poses)).numpy()
        turned = np.zeros_like(rotations)
        carried = np.zeros((len(rotations), 5, 5, 3, 3))
        for joint, parent in enumerate(self._parents):
            if parent < 0:
                turned[:, joint] = rotations[:, joint]
                carried[:, joint, joint] = np.eye(3)
                continue
            turned[:, joint] = turned[:, parent] @ rotations[:, joint]
            carried[:, joint] = carried[:, parent]
            carried[:, joint, joint] += turned[:, parent]
            carried[:, joint, parent] -= turned[:, parent]
        # Up to here where each joint goes; minus where its rotation alone would take it.
        for joint in range(5):
            carried[:, joint, joint] -= turned[:, joint]
        features = (rotations[:, 1:] - np.eye(3)).reshape(len(poses), 36)
        return _Chain(turned, carried, features)
