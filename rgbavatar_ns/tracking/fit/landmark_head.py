"""The head model reduced to its landmarks: exact, and small enough for many fits a second."""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.joints import JAW, JOINT_FIELDS, NECK
from rgbavatar_ns.head.landmarks import LandmarkResponse
from rgbavatar_ns.tracking.fit.pose_chain import (
    PoseChain,
    PoseView,
    cross_matrices,
    rotation_matrices,
    signal_slopes,
)

_MOVES = 1e-9
"""Share of the largest squared motion below which a mixture of coefficients moves no landmark."""

_Theta = Float[np.ndarray, "H"]
_Identity = Float[np.ndarray, "I"]
_Point = Float[np.ndarray, "3"]
_Coefficients = Float[np.ndarray, "C"]


@dataclass(frozen=True)
class _Moments:
    """What the joints carry of each landmark: M of them, as many as any landmark has weights on.

    `joint` are these joints; where a landmark has fewer, what stands in the other places is 0.
    share sums barycentric * skinning weight; rest, dirs and pose_dirs are the positions' and
    offsets' sums with the same weights; slides is what a detector's response adds for each signal.
    """

    joint: Int[np.ndarray, "L M"]
    share: Float[np.ndarray, "L M"]
    rest: Float[np.ndarray, "L M 3"]
    dirs: Float[np.ndarray, "L M 3 C"]
    pose_dirs: Float[np.ndarray, "L M 3 36"] | None
    slides: Float[np.ndarray, "L M 3 8"] | None = None

    @classmethod
    def of(
        cls,
        shares: Float[np.ndarray, "L 3 5"],
        vertex_ids: Int[np.ndarray, "L 3"],
        template: Float[np.ndarray, "V 3"],
        dirs: Float[np.ndarray, "V 3 C"],
        pose_dirs: Float[np.ndarray, "V 3 36"],
    ) -> "_Moments":
        """Of landmarks between three vertices each; `shares` are barycentric * skinning weight."""
        has = shares.any(1)
        most = int(has.sum(1).max())
        joint = np.argsort(~has, axis=1, kind="stable")[:, :most]
        weights = np.take_along_axis(shares.transpose(0, 2, 1), joint[..., None], axis=1)
        corners = pose_dirs[vertex_ids].astype(np.float64)
        posed = np.einsum("lmk,lkxp->lmxp", weights, corners) if np.any(corners) else None
        return cls(
            joint,
            weights.sum(2),
            np.einsum("lmk,lkx->lmx", weights, template[vertex_ids]),
            np.einsum("lmk,lkxc->lmxc", weights, dirs[vertex_ids]),
            posed,
        )

    def joint_shares(self) -> Float[np.ndarray, "L 5"]:
        """How much of each landmark each joint carries."""
        shares = np.zeros((len(self.joint), len(JOINT_FIELDS)))
        np.put_along_axis(shares, self.joint, self.share, axis=1)
        return shares


@dataclass(frozen=True)
class Unknowns:
    """What a fit asks derivatives for: Q places in the derivative's last axis.

    `joints` and `axes` say which entries of axis angles A of the places are, `angles` at which
    places; `carries` tells what a turn of each carries, joint by joint. `dirs` and `joint_dirs` are
    derivatives of what rests to the places that are coefficients, and 0 elsewhere; `shifts` those
    of a joint's place to the translation.
    """

    angles: Int[np.ndarray, "A"]
    joints: Int[np.ndarray, "A"]
    axes: Int[np.ndarray, "A"]
    carries: Float[np.ndarray, "5 A"]
    dirs: Float[np.ndarray, "L M 3 Q"]
    joint_dirs: Float[np.ndarray, "5 3 Q"]
    shifts: Float[np.ndarray, "3 Q"]


@dataclass(frozen=True)
class PosedLandmarks:
    """Landmarks of one pose, and what their derivatives are made from."""

    points_m: Float[np.ndarray, "L 3"]
    carried_m: Float[np.ndarray, "L M 3"]
    """What each joint adds to them."""
    view: PoseView


class LandmarkHead:
    """Points at barycentric places of the head's triangles as functions of theta and identity.

    Skinning is linear in the rest positions, so each landmark needs only its skinning-weighted
    moments per joint: sum over its three vertices of barycentric * weight * position. That equals
    the full `HeadModel` at these points (a test compares them). float64 numpy throughout, in few
    calls: on arrays this small a call costs more than its arithmetic.
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
        self._moments = _Moments.of(shares, vertex_ids, template, dirs, arrays.posedirs)
        self._joint_shares = self._moments.joint_shares()
        regressor = arrays.joint_regressor.astype(np.float64)
        self._joint_rest = regressor @ template
        # Eyelids shift no joint.
        joint_dirs = np.tensordot(regressor, shape_dirs, axes=1)
        self._joint_dirs = np.concatenate([joint_dirs, np.zeros((5, *lids.shape[1:]))], axis=2)
        self._parents = [int(parent) for parent in arrays.parents]

    def of_person(self, identity: _Identity) -> "LandmarkHead":
        """The same head with this identity folded in: smaller, and its identity has size 0."""
        count, moments = self.num_identity, self._moments
        person = copy(self)
        person.num_identity = 0
        person._moments = replace(
            moments,
            rest=moments.rest + moments.dirs[..., :count] @ identity,
            dirs=np.ascontiguousarray(moments.dirs[..., count:]),
        )
        person._joint_rest = self._joint_rest + self._joint_dirs[..., :count] @ identity
        person._joint_dirs = np.ascontiguousarray(self._joint_dirs[..., count:])
        return person

    def with_offsets(self, offsets_m: Float[np.ndarray, "L 3"]) -> "LandmarkHead":
        """Every landmark moved at rest; skinning carries the offsets along."""
        moved, moments = copy(self), self._moments
        rest = moments.rest + moments.share[..., None] * offsets_m[:, None]
        moved._moments = replace(moments, rest=rest)
        return moved

    def with_response(self, response: LandmarkResponse) -> "LandmarkHead":
        """The same landmarks where a detector sees them; before any identity is folded in."""
        slides = np.concatenate([response.view, response.jaw_open[..., None], response.gaze], -1)
        # A bust has directions more, of its body: none of them moves a landmark.
        first, known = self.num_identity, (response.identity, response.expression)
        places = np.concatenate(
            [np.arange(known[0].shape[-1]), first + np.arange(known[1].shape[-1])]
        )
        moved, moments = copy(self), self._moments
        share = moments.share[..., None, None]
        dirs = moments.dirs.copy()
        dirs[..., places] += share * np.concatenate(known, -1)[:, None]
        rest = moments.rest + share[..., 0] * response.rest[:, None]
        moved._moments = replace(moments, rest=rest, dirs=dirs, slides=share * slides[:, None])
        return moved

    def expression_size_m(self) -> Float[np.ndarray, "E"]:
        """How far each expression at 1 moves the landmark that it moves most."""
        first = self.num_identity
        count = self.layout.slice("expression").stop - self.layout.slice("expression").start
        moved = self._moments.dirs[..., first : first + count].sum(1)
        return np.linalg.norm(moved, axis=1).max(0)

    def depth_share(self, identity_columns: int) -> Float[np.ndarray, "C C"]:
        """How much of what the first C identity coefficients do to landmarks at rest is in depth.

        G^-1/2 D G^-1/2 with the inner products G of these motions and D of what they have along z:
        of a coefficient by itself, or whose motion is orthogonal to the others', the share of its
        squared motion, 0 to 1. Of mixtures only about: some that keep within the picture have a
        part too. What moves no landmark has none.
        """
        moved = self._moments.dirs[..., :identity_columns].sum(1)
        sizes, directions = np.linalg.eigh(np.einsum("lxc,lxd->cd", moved, moved))
        seen = sizes > _MOVES * sizes.max(initial=0.0)
        even = directions[:, seen] * sizes[seen] ** -0.5 @ directions[:, seen].T
        ahead = moved[:, 2] @ even
        return ahead.T @ ahead

    def unknowns(self, theta_columns: Int[np.ndarray, "P"], identity_columns: int = 0) -> Unknowns:
        """Entries of theta, then the identity's first coefficients, as unknowns of a fit."""
        kinds: dict[int, tuple[str, int]] = {}
        for joint, name in enumerate(JOINT_FIELDS):
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

        def of_kind(wanted: str) -> Int[np.ndarray, "2 _"]:
            """Places in the derivative, and numbers within the kind."""
            found = [(n, source) for n, (kind, source) in enumerate(asked) if kind == wanted]
            return np.array(found, dtype=np.int64).reshape(-1, 2).T

        angles, entries = of_kind("angle")
        joints, axes = np.divmod(entries, 3)
        carries = [[self._hangs_on(own, joint) for joint in joints.tolist()] for own in range(5)]
        places, sources = of_kind("coefficient")
        dirs = np.zeros((*self._moments.rest.shape, len(asked)))
        joint_dirs, shifts = np.zeros((5, 3, len(asked))), np.zeros((3, len(asked)))
        dirs[..., places] = self._moments.dirs[..., sources]
        joint_dirs[..., places] = self._joint_dirs[..., sources]
        along, directions = of_kind("shift")
        shifts[directions, along] = 1.0
        carried = np.array(carries, dtype=np.float64)
        return Unknowns(angles, joints, axes, carried, dirs, joint_dirs, shifts)

    def points(
        self, theta: _Theta, identity: _Identity, eye_m: _Point | None = None
    ) -> Float[np.ndarray, "L 3"]:
        """Landmarks in world space, metres; a response sees them from `eye_m` (far off in z)."""
        return self.posed(theta, identity, eye_m).points_m

    def posed(
        self, theta: _Theta, identity: _Identity, eye_m: _Point | None = None
    ) -> PosedLandmarks:
        """Landmarks as `points` has them, from which `derivative` goes on."""
        coefficients, moments = self._coefficients(theta, identity), self._moments
        view = self._view(theta, coefficients, eye_m)
        chain = view.chain
        rest = moments.rest + _times(moments.dirs, coefficients)
        if moments.pose_dirs is not None:
            rest += _times(moments.pose_dirs, chain.features)
        if moments.slides is not None:
            rest += _times(moments.slides, view.signals)
        shift = chain.placed - (chain.turned @ chain.at_rest[..., None])[..., 0]
        carried = np.einsum("lmxy,lmy->lmx", chain.turned[moments.joint], rest)
        carried += moments.share[..., None] * shift[moments.joint]
        return PosedLandmarks(carried.sum(1), carried, view)

    def derivative(self, posed: PosedLandmarks, unknowns: Unknowns) -> Float[np.ndarray, "L 3 Q"]:
        """Of landmarks in metres to `unknowns` of this head.

        Exact but for the direction to the camera, which counts as fixed while the head moves
        sideways.
        """
        view, chain, moments = posed.view, posed.view.chain, self._moments
        joints, axes, angles = unknowns.joints, unknowns.axes, unknowns.angles
        local_spins = chain.local_spins()[joints, :, axes]
        spins = (chain.above[joints] @ local_spins[..., None])[..., 0]
        # All joints of a landmark in one product: (3, 3 M) (3 M, Q).
        count, size = len(moments.joint), unknowns.dirs.shape[-1]
        turned = chain.turned[moments.joint].transpose(0, 2, 1, 3).reshape(count, 3, -1)
        result = turned @ unknowns.dirs.reshape(count, -1, size)
        # A joint's turn carries what hangs on it about the joint.
        cross = cross_matrices(spins)
        pivots = (cross @ chain.placed[joints][..., None])[..., 0].T
        swung = _times(posed.carried_m, cross.transpose(2, 1, 0).reshape(3, -1))
        swung = swung.reshape(*moments.rest.shape, -1) - moments.share[..., None, None] * pivots
        by_angle = (swung * unknowns.carries[moments.joint][:, :, None]).sum(1)
        if moments.slides is not None:
            slid = _times(moments.slides, signal_slopes(view, joints, axes, spins))
            by_angle += turned @ slid.reshape(count, -1, len(joints))
        if moments.pose_dirs is not None:
            turning = cross_matrices(local_spins) @ chain.local[joints]
            slopes = np.zeros((len(JOINT_FIELDS), 9, len(joints)))
            slopes[joints, :, np.arange(len(joints))] = turning.reshape(-1, 9)
            corrected = _times(moments.pose_dirs, slopes[1:].reshape(36, -1))
            by_angle += turned @ corrected.reshape(count, -1, len(joints))
        result[..., angles] += by_angle
        shifts = self._joint_shifts(chain, unknowns).reshape(len(JOINT_FIELDS), -1)
        result += (self._joint_shares @ shifts).reshape(result.shape)
        return result

    def head_rotation(self, theta: _Theta) -> Float[np.ndarray, "3 3"]:
        """World rotation of the skull: global rotation, then neck."""
        return self._chain(theta, np.zeros(self._joint_dirs.shape[-1])).turned[NECK]

    def chain(self, theta: _Theta, identity: _Identity) -> PoseChain:
        """The joints of a pose."""
        return self._chain(theta, self._coefficients(theta, identity))

    def skinning(self, chain: PoseChain) -> Float[np.ndarray, "L 3 3"]:
        """How a pose turns what is added to each landmark at rest."""
        return np.tensordot(self._joint_shares, chain.turned, axes=1)

    def _coefficients(self, theta: _Theta, identity: _Identity) -> _Coefficients:
        parts = [identity, theta[self.layout.slice("expression")]]
        if "eyelids" in self.layout:
            parts.append(theta[self.layout.slice("eyelids")])
        return np.concatenate(parts)

    def _joint_shifts(self, chain: PoseChain, unknowns: Unknowns) -> Float[np.ndarray, "5 3 Q"]:
        """How what a joint carries moves as the joints' own places do."""
        placed, own = np.zeros_like(unknowns.joint_dirs), unknowns.joint_dirs
        for joint, parent in enumerate(self._parents):
            if parent < 0:
                placed[joint] = own[joint] + unknowns.shifts
            else:
                placed[joint] = placed[parent] + chain.above[joint] @ (own[joint] - own[parent])
        return placed - chain.turned @ own

    def _hangs_on(self, joint: int, ancestor: int) -> bool:
        while joint != ancestor and joint >= 0:
            joint = self._parents[joint]
        return joint == ancestor

    def _view(self, theta: _Theta, coefficients: _Coefficients, eye_m: _Point | None) -> PoseView:
        chain = self._chain(theta, coefficients)
        towards = np.array([0.0, 0.0, 1.0]) if eye_m is None else eye_m - chain.placed[NECK]
        towards = towards / np.linalg.norm(towards)
        x, y, _ = chain.turned[NECK].T @ towards
        angles = np.zeros((3, 2))
        for row, name in enumerate(JOINT_FIELDS[JAW:]):
            if name in self.layout:
                angles[row] = theta[self.layout.slice(name)][:2]
        sines = np.sin(angles)
        signals = np.array([x, y, x * x, y * y, x * y, sines[0, 0], *sines[1:].mean(0)])
        return PoseView(chain, towards, np.cos(angles), signals)

    def _chain(self, theta: _Theta, coefficients: _Coefficients) -> PoseChain:
        poses = np.zeros((5, 3))
        for joint, name in enumerate(JOINT_FIELDS):
            if name in self.layout:
                poses[joint] = theta[self.layout.slice(name)]
        local = rotation_matrices(poses)
        at_rest = self._joint_rest + self._joint_dirs @ coefficients
        turned, placed, above = local.copy(), at_rest.copy(), np.tile(np.eye(3), (5, 1, 1))
        for joint, parent in enumerate(self._parents):
            if parent < 0:
                placed[joint] += theta[self.layout.slice("translation")]
                continue
            above[joint] = turned[parent]
            turned[joint] = above[joint] @ local[joint]
            placed[joint] = placed[parent] + above[joint] @ (at_rest[joint] - at_rest[parent])
        return PoseChain(poses, local, above, turned, at_rest, placed)


def _times(rows: Float[np.ndarray, "*L C"], factor: Float[np.ndarray, "C *A"]) -> np.ndarray:
    """Their product as that of two matrices, where numpy would make many small ones."""
    return (rows.reshape(-1, rows.shape[-1]) @ factor).reshape(*rows.shape[:-1], *factor.shape[1:])
