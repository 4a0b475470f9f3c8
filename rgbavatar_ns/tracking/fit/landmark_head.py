"""The head model reduced to its landmarks: exact, and small enough for many fits a second."""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.landmarks import LandmarkResponse
from rgbavatar_ns.tracking.fit.pose_chain import (
    JAW,
    NUM_SIGNALS,
    ROOT,
    SKULL,
    PoseChain,
    PoseView,
    angular_velocities,
    cross_matrix,
    rotation_matrices,
    signal_slope,
)

_Theta = Float[np.ndarray, "H"]
_Identity = Float[np.ndarray, "I"]
_Point = Float[np.ndarray, "3"]
_Coefficients = Float[np.ndarray, "C"]

POSE_FIELDS = ("rotation", "neck", "jaw", "left_eye", "right_eye")


@dataclass(frozen=True)
class _JointMoments:
    """What one joint carries: `rows` are the landmarks with any weight on it.

    share [R] sums barycentric * skinning weight; rest [3, R], dirs [3, R, C] and pose_dirs
    [3, R, 36] are the positions' and offsets' sums with the same weights; slides [3, R, 8] is what
    a detector's response adds for each signal.
    """

    joint: int
    rows: Int[np.ndarray, "R"]
    share: Float[np.ndarray, "R"]
    rest: Float[np.ndarray, "3 R"]
    dirs: Float[np.ndarray, "3 R C"]
    pose_dirs: Float[np.ndarray, "3 R 36"] | None
    slides: Float[np.ndarray, "3 R 8"] | None = None


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

    def of_person(self, identity: _Identity) -> "LandmarkHead":
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

    def with_response(self, response: LandmarkResponse) -> "LandmarkHead":
        """The same landmarks where a detector sees them; before any identity is folded in."""
        slides = np.concatenate([response.view, response.jaw_open[..., None], response.gaze], -1)
        # A bust has directions more, of its body: none of them moves a landmark.
        first, known = self.num_identity, (response.identity, response.expression)
        places = np.concatenate(
            [np.arange(known[0].shape[-1]), first + np.arange(known[1].shape[-1])]
        )
        coefficients = np.concatenate(known, -1)
        moved = copy(self)
        moved._moments = []
        for part in self._moments:
            share = part.share[:, None, None]
            dirs = part.dirs.copy()
            dirs[..., places] += (share * coefficients[part.rows]).transpose(1, 0, 2)
            rest = part.rest + (share[..., 0] * response.rest[part.rows]).T
            own = np.ascontiguousarray((share * slides[part.rows]).transpose(1, 0, 2))
            moved._moments.append(replace(part, rest=rest, dirs=dirs, slides=own))
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
        self, theta: _Theta, identity: _Identity, eye_m: _Point | None = None
    ) -> Float[np.ndarray, "L 3"]:
        """Landmarks in world space, metres; a response sees them from `eye_m` (far off in z)."""
        coefficients = self._coefficients(theta, identity)
        view = self._view(theta, coefficients, eye_m)
        return sum(self._carried(view, coefficients), np.zeros((3, self.num_landmarks))).T

    def head_rotation(self, theta: _Theta) -> Float[np.ndarray, "3 3"]:
        """World rotation of the skull: global rotation, then neck."""
        return self._chain(theta, np.zeros(self._joint_dirs.shape[-1])).turned[SKULL]

    def chain(self, theta: _Theta, identity: _Identity) -> PoseChain:
        """The joints of a pose."""
        return self._chain(theta, self._coefficients(theta, identity))

    def jacobian(
        self, theta: _Theta, identity: _Identity, unknowns: Unknowns, eye_m: _Point | None = None
    ) -> tuple[Float[np.ndarray, "L 3"], Float[np.ndarray, "3 L Q"]]:
        """Landmarks in metres, with their derivatives to `unknowns` of this head.

        Exact but for the direction to the camera, which counts as fixed while the head moves
        sideways.
        """
        coefficients = self._coefficients(theta, identity)
        view = self._view(theta, coefficients, eye_m)
        carried, chain = self._carried(view, coefficients), view.chain
        derivative = np.zeros((3, self.num_landmarks, unknowns.size))
        derivative[..., unknowns.coefficients] = self._coefficient_jacobian(chain, unknowns)
        for axis, place in unknowns.shifts:
            derivative[axis, :, place] = 1.0
        slid = self._slid(chain)
        for joint in range(len(POSE_FIELDS)):
            asked = [(axis, place) for own, axis, place in unknowns.angles if own == joint]
            if asked:
                axes, places = (list(part) for part in zip(*asked))
                derivative[..., places] = self._turning(view, carried, joint, axes)
                if slid is not None:
                    slopes = [signal_slope(view, joint, axis) for axis in axes]
                    derivative[..., places] += slid @ np.stack(slopes, axis=-1)
        return sum(carried, np.zeros((3, self.num_landmarks))).T, derivative

    def _coefficients(self, theta: _Theta, identity: _Identity) -> _Coefficients:
        parts = [identity, theta[self.layout.slice("expression")]]
        if "eyelids" in self.layout:
            parts.append(theta[self.layout.slice("eyelids")])
        return np.concatenate(parts)

    def _carried(
        self, view: PoseView, coefficients: _Coefficients
    ) -> list[Float[np.ndarray, "3 L"]]:
        """What each part of `_moments` adds to the landmarks in the world."""
        found, chain = [], view.chain
        for part in self._moments:
            rest = part.rest + part.dirs @ coefficients
            if part.pose_dirs is not None:
                rest = rest + part.pose_dirs @ chain.features
            if part.slides is not None:
                rest = rest + part.slides @ view.signals
            rest -= part.share * chain.at_rest[part.joint][:, None]
            carried = np.zeros((3, self.num_landmarks))
            placed = chain.placed[part.joint][:, None] * part.share
            carried[:, part.rows] = chain.turned[part.joint] @ rest + placed
            found.append(carried)
        return found

    def _coefficient_jacobian(
        self, chain: PoseChain, unknowns: Unknowns
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
        self, view: PoseView, carried: list[Float[np.ndarray, "3 L"]], joint: int, axes: list[int]
    ) -> Float[np.ndarray, "3 L A"]:
        """Derivative of the landmarks to entries of a joint's axis angle."""
        chain = view.chain
        lever = np.zeros((3, self.num_landmarks))
        for part, own in zip(self._moments, carried):
            if self._hangs_on(part.joint, joint):
                lever += own
                lever[:, part.rows] -= chain.placed[joint][:, None] * part.share
        spins = chain.spin[joint][:, axes]
        moved = np.stack([cross_matrix(spin) @ lever for spin in spins.T], axis=-1)
        if joint == ROOT:
            return moved
        above = chain.turned[self._parents[joint]].T
        local = np.stack([cross_matrix(above @ spin) @ chain.local[joint] for spin in spins.T], -1)
        for part in self._moments:
            if part.pose_dirs is not None:
                own = part.pose_dirs[..., 9 * joint - 9 : 9 * joint] @ local.reshape(9, -1)
                turned = chain.turned[part.joint] @ own.reshape(3, -1)
                moved[:, part.rows] += turned.reshape(3, -1, len(axes))
        return moved

    def _slid(self, chain: PoseChain) -> Float[np.ndarray, "3 L 8"] | None:
        """What each signal moves in the world."""
        slid = None
        for part in self._moments:
            if part.slides is not None:
                slid = np.zeros((3, self.num_landmarks, NUM_SIGNALS)) if slid is None else slid
                own = chain.turned[part.joint] @ part.slides.reshape(3, -1)
                slid[:, part.rows] += own.reshape(part.slides.shape)
        return slid

    def _hangs_on(self, joint: int, ancestor: int) -> bool:
        while joint != ancestor and joint >= 0:
            joint = self._parents[joint]
        return joint == ancestor

    def _view(self, theta: _Theta, coefficients: _Coefficients, eye_m: _Point | None) -> PoseView:
        chain = self._chain(theta, coefficients)
        towards = np.array([0.0, 0.0, 1.0]) if eye_m is None else eye_m - chain.placed[SKULL]
        towards = towards / np.linalg.norm(towards)
        x, y, _ = chain.turned[SKULL].T @ towards
        angles = np.zeros((3, 2))
        for row, name in enumerate(POSE_FIELDS[JAW:]):
            if name in self.layout:
                angles[row] = theta[self.layout.slice(name)][:2]
        sines = np.sin(angles)
        signals = np.array([x, y, x * x, y * y, x * y, sines[0, 0], *sines[1:].mean(0)])
        return PoseView(chain, towards, np.cos(angles), signals)

    def _chain(self, theta: _Theta, coefficients: _Coefficients) -> PoseChain:
        poses = np.zeros((5, 3))
        for joint, name in enumerate(POSE_FIELDS):
            if name in self.layout:
                poses[joint] = theta[self.layout.slice(name)]
        local = rotation_matrices(poses)
        at_rest = self._joint_rest + self._joint_dirs @ coefficients
        turned, placed, spin = local.copy(), at_rest.copy(), np.zeros((5, 3, 3))
        for joint, parent in enumerate(self._parents):
            above = turned[parent] if parent >= 0 else np.eye(3)
            spin[joint] = above @ angular_velocities(poses[joint], local[joint])
            if parent < 0:
                placed[joint] += theta[self.layout.slice("translation")]
                continue
            turned[joint] = above @ local[joint]
            placed[joint] = placed[parent] + above @ (at_rest[joint] - at_rest[parent])
        return PoseChain(local, turned, spin, at_rest, placed)
