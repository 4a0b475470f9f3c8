"""The head model reduced to its landmarks: exact, and small enough for many fits a second."""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix

POSE_FIELDS = ("rotation", "neck", "jaw", "left_eye", "right_eye")
_SKULL = 1
_NO_ANGLE_RAD = 1e-7


@dataclass(frozen=True)
class LandmarkJacobian:
    """Landmarks [L, 3] in metres with their derivatives [3, L, Q] to the unknowns asked for."""

    points: Float[np.ndarray, "L 3"]
    derivative: Float[np.ndarray, "3 L Q"]


@dataclass(frozen=True)
class _Chain:
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


@dataclass(frozen=True)
class Unknowns:
    """What a fit asks derivatives for, in this order: places in the derivative's last axis.

    angles: (joint, axis, place); shifts: (axis, place); coefficients: their places, and each
    joint's `dirs` and joint directions for them alone.
    """

    size: int
    angles: tuple[tuple[int, int, int], ...]
    shifts: tuple[tuple[int, int], ...]
    coefficients: Int[np.ndarray, "K"]
    dirs: tuple[Float[np.ndarray, "3 _"], ...]
    joint_dirs: Float[np.ndarray, "5 3 K"]


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

    def unknowns(self, theta_columns: Int[np.ndarray, "P"], identity_columns: int = 0) -> Unknowns:
        """Entries of theta, then the identity's first coefficients, as unknowns of a fit."""
        kinds: dict[int, tuple[str, int]] = {}
        for joint, name in enumerate(POSE_FIELDS):
            if name in self.layout:
                first = self.layout.slice(name).start
                kinds |= {first + axis: ("angle", 3 * joint + axis) for axis in range(3)}
        first = self.layout.slice("translation").start
        kinds |= {first + axis: ("shift", axis) for axis in range(3)}
        place = self.num_identity
        for name in ("expression", "eyelids"):
            if name in self.layout:
                part = self.layout.slice(name)
                for column in range(part.start, part.stop):
                    kinds[column] = ("coefficient", place)
                    place += 1
        asked = [kinds[int(column)] for column in theta_columns]
        asked += [("coefficient", number) for number in range(identity_columns)]
        rows = [(number, kind[1]) for number, kind in enumerate(asked) if kind[0] == "coefficient"]
        sources = [source for _, source in rows]
        return Unknowns(
            len(asked),
            tuple((s // 3, s % 3, n) for n, (kind, s) in enumerate(asked) if kind == "angle"),
            tuple((s, n) for n, (kind, s) in enumerate(asked) if kind == "shift"),
            np.array([number for number, _ in rows], dtype=np.int64),
            tuple(part.dirs[..., sources].reshape(3, -1) for part in self._moments),
            self._joint_dirs[..., sources],
        )

    def points(
        self, theta: Float[np.ndarray, "H"], identity: Float[np.ndarray, "I"]
    ) -> Float[np.ndarray, "L 3"]:
        """Landmarks in world space, metres."""
        coefficients = self._coefficients(theta, identity)
        chain = self._chain(theta, coefficients)
        return sum(self._carried(chain, coefficients), np.zeros((3, self.num_landmarks))).T

    def head_rotation(self, theta: Float[np.ndarray, "H"]) -> Float[np.ndarray, "3 3"]:
        """World rotation of the skull: global rotation, then neck."""
        return self._chain(theta, np.zeros(self._joint_dirs.shape[-1])).turned[_SKULL]

    def jacobian(
        self, theta: Float[np.ndarray, "H"], identity: Float[np.ndarray, "I"], unknowns: Unknowns
    ) -> LandmarkJacobian:
        """Landmarks with their exact derivatives to `unknowns` of this head."""
        coefficients = self._coefficients(theta, identity)
        chain = self._chain(theta, coefficients)
        carried = self._carried(chain, coefficients)
        derivative = np.zeros((3, self.num_landmarks, unknowns.size))
        derivative[..., unknowns.coefficients] = self._coefficient_jacobian(chain, unknowns)
        for axis, place in unknowns.shifts:
            derivative[axis, :, place] = 1.0
        for joint, axis, place in unknowns.angles:
            derivative[..., place] = self._turning(chain, carried, joint, axis)
        return LandmarkJacobian(sum(carried, np.zeros((3, self.num_landmarks))).T, derivative)

    def _coefficients(
        self, theta: Float[np.ndarray, "H"], identity: Float[np.ndarray, "I"]
    ) -> Float[np.ndarray, "C"]:
        parts = [identity, theta[self.layout.slice("expression")]]
        if "eyelids" in self.layout:
            parts.append(theta[self.layout.slice("eyelids")])
        return np.concatenate(parts)

    def _carried(
        self, chain: _Chain, coefficients: Float[np.ndarray, "C"]
    ) -> list[Float[np.ndarray, "3 L"]]:
        """What each part of `_moments` adds to the landmarks in the world."""
        found = []
        for part in self._moments:
            rest = part.rest + part.dirs @ coefficients
            if part.pose_dirs is not None:
                rest = rest + part.pose_dirs @ chain.features
            rest -= part.share * chain.at_rest[part.joint][:, None]
            carried = np.zeros((3, self.num_landmarks))
            placed = chain.placed[part.joint][:, None] * part.share
            carried[:, part.rows] = chain.turned[part.joint] @ rest + placed
            found.append(carried)
        return found

    def _coefficient_jacobian(
        self, chain: _Chain, unknowns: Unknowns
    ) -> Float[np.ndarray, "3 L K"]:
        placed = np.zeros_like(unknowns.joint_dirs)
        for joint, parent in enumerate(self._parents):
            placed[joint] = unknowns.joint_dirs[joint]
            if parent >= 0:
                apart = unknowns.joint_dirs[joint] - unknowns.joint_dirs[parent]
                placed[joint] = placed[parent] + chain.turned[parent] @ apart
        moved = np.zeros((3, self.num_landmarks, unknowns.joint_dirs.shape[-1]))
        for part, dirs in zip(self._moments, unknowns.dirs):
            turned = chain.turned[part.joint]
            shift = placed[part.joint] - turned @ unknowns.joint_dirs[part.joint]
            own = (turned @ dirs).reshape(3, len(part.rows), -1)
            moved[:, part.rows] += own + part.share[:, None] * shift[:, None]
        return moved

    def _turning(
        self,
        chain: _Chain,
        carried: list[Float[np.ndarray, "3 L"]],
        joint: int,
        axis: int,
    ) -> Float[np.ndarray, "3 L"]:
        """Derivative of the landmarks to one entry of a joint's axis angle."""
        spin = chain.spin[joint, :, axis]
        lever = np.zeros((3, self.num_landmarks))
        for part, own in zip(self._moments, carried):
            if self._hangs_on(part.joint, joint):
                lever += own
                lever[:, part.rows] -= chain.placed[joint][:, None] * part.share
        moved = _cross_matrix(spin) @ lever
        if joint == 0:
            return moved
        local = _cross_matrix(chain.turned[self._parents[joint]].T @ spin) @ chain.local[joint]
        for part in self._moments:
            if part.pose_dirs is not None:
                corrected = part.pose_dirs[..., 9 * joint - 9 : 9 * joint] @ local.reshape(9)
                moved[:, part.rows] += chain.turned[part.joint] @ corrected
        return moved

    def _hangs_on(self, joint: int, ancestor: int) -> bool:
        while joint != ancestor and joint >= 0:
            joint = self._parents[joint]
        return joint == ancestor

    def _chain(self, theta: Float[np.ndarray, "H"], coefficients: Float[np.ndarray, "C"]) -> _Chain:
        poses = np.zeros((5, 3))
        for joint, name in enumerate(POSE_FIELDS):
            if name in self.layout:
                poses[joint] = theta[self.layout.slice(name)]
        local = axis_angle_to_matrix(torch.from_numpy(poses)).numpy()
        at_rest = self._joint_rest + self._joint_dirs @ coefficients
        turned, placed, spin = local.copy(), at_rest.copy(), np.zeros((5, 3, 3))
        for joint, parent in enumerate(self._parents):
            above = turned[parent] if parent >= 0 else np.eye(3)
            spin[joint] = above @ _spin(poses[joint], local[joint])
            if parent < 0:
                placed[joint] += theta[self.layout.slice("translation")]
                continue
            turned[joint] = above @ local[joint]
            placed[joint] = placed[parent] + above @ (at_rest[joint] - at_rest[parent])
        return _Chain(local, turned, spin, at_rest, placed)


def _cross_matrix(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _spin(
    axis_angle: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    """Column k: angular velocity of exp(v) as v's entry k grows (Gallego and Yezzi 2015)."""
    squared = float(axis_angle @ axis_angle)
    if squared < _NO_ANGLE_RAD**2:
        return np.eye(3)
    across = _cross_matrix(axis_angle) @ (np.eye(3) - rotation)
    return (np.outer(axis_angle, axis_angle) + across) / squared
