"""The embedded head's face laid over another head: pose, size and person, then the rest."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.joints import EYES
from rgbavatar_ns.head.landmarks import facemesh_landmarks
from rgbavatar_ns.head.skin_surface import SkinPoints, SkinSurface, is_skin, skin_points

# What lies this near to a landmark is the face; a rim around it counts as little.
_FACE_M, _RIM_M, _RIM_WEIGHT = 0.02, 0.04, 0.05
# How unlike a point and its nearest place may be before they count less, step by step.
_REACH_M = np.geomspace(0.02, 0.004, 30)
_SIGMA_M = 0.002
_EYE_WEIGHT, _IDENTITY_WEIGHT = 60.0, 4.0
# What is no head must not end in numbers that are none: radians, metres, log of size.
_DAMPING, _LONGEST_STEP = 1e-7, 0.2
# From a plate to a cloth, and how much of a distance along the surface counts: points may slide.
_STIFFNESS = (300.0, 30.0, 3.0)
_ALONG = 0.05
# A head on which no person of the embedded one's comes nearer than this is no face. Neither is one
# far from upright or of another size: the tracker knows heads in metres.
_NO_FACE_M, _MOST_TURNED, _MOST_GROWN = 0.006, 0.5, 1.5


@dataclass(frozen=True)
class SimilarityTransform:
    """x -> scale * turn @ x + shift, metres."""

    scale: float
    turn: Float[np.ndarray, "3 3"]
    shift_m: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Points moved."""
        return self.scale * points @ self.turn.T + self.shift_m

    def moved(self, step: Float[np.ndarray, "7"]) -> "SimilarityTransform":
        """The same, then turned, shifted and grown (log) about the origin."""
        turn, grown = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[6]))
        shift_m = grown * turn @ self.shift_m + step[3:6]
        return SimilarityTransform(self.scale * grown, turn @ self.turn, shift_m)


@dataclass(frozen=True)
class Registration:
    """Where the embedded head lies on another head at rest."""

    pose: SimilarityTransform
    identity: Float[np.ndarray, "I"]
    """The embedded head's coefficients that come nearest to the other head."""
    placed: Float[np.ndarray, "V 3"]
    """All the embedded head's vertices, metres; those of the face lie on the other head."""
    face_vertices: Int[np.ndarray, "F"]
    """Which of them are the face."""


def register(head: HeadArrays) -> Registration:
    """Lay the embedded head's face over `head`, whose joints and axes are FLAME's.

    The centres of the eyes give size and place. Then pose, size and identity are fitted to the
    nearest skin of like normal and jaw weight (reweighted point-to-plane ICP), and what is left is
    closed by a smooth deformation (non-rigid ICP, Amberg et al. 2007, but with a squared Laplacian
    for its stiffness and without its landmarks, which are what is looked for). Raises UserError
    for a head without a face.
    """
    surface, face = SkinSurface(head), _Face()
    eyes = (head.joint_regressor.astype(np.float64) @ head.v_template)[EYES]
    pose, identity = _fit_person(face, surface, eyes)
    turned = Rotation.from_matrix(pose.turn).magnitude()
    if turned > _MOST_TURNED or not 1 / _MOST_GROWN < pose.scale < _MOST_GROWN:
        why = f"it has to be turned by {np.degrees(turned):.0f} degrees and made {pose.scale:.2g}"
        raise _no_face(head, f"{why} times as large")
    placed = pose(face.vertices(identity))
    unlike_m = float(np.median(surface.sampled(face.points(placed))[1][face.weight == 1]))
    if unlike_m > _NO_FACE_M:
        raise _no_face(head, f"it stays {1e3 * unlike_m:.0f} mm away")
    placed = _close_the_rest(face, surface, placed)
    return Registration(pose, identity, placed, face.rows[face.weight == 1])


def _no_face(head: HeadArrays, why: str) -> UserError:
    return UserError(
        f"No face was found on the head model '{head.name}' by laying the embedded head over it: "
        f"{why}.",
        "Name a FLAME model or a head in its axes (metres, y up, the face towards +z), or track "
        "with the embedded head.",
    )


class _Face:
    """The part of the embedded head that is laid over another one."""

    def __init__(self) -> None:
        self._arrays = arrays = HeadArrays.embedded()
        self._template = arrays.v_template.astype(np.float64)
        directions = arrays.shapedirs[..., : arrays.num_identity].astype(np.float64)
        self._all_directions = directions
        regressor = arrays.joint_regressor.astype(np.float64)[EYES]
        self.eyes = regressor @ self._template
        self.eye_directions = np.tensordot(regressor, directions, axes=1)
        marks, skin = facemesh_landmarks(), is_skin(arrays)
        corners = self._template[arrays.faces[marks.triangle]]
        landmarks = np.einsum("lk,lkx->lx", marks.barycentric, corners)
        away_m, _ = KDTree(landmarks).query(self._template)
        self.rows = np.flatnonzero(skin & (away_m < _RIM_M))
        self.weight = np.where(away_m[self.rows] < _FACE_M, 1.0, _RIM_WEIGHT)
        self.directions = directions[self.rows]
        self._skin_faces = arrays.faces[skin[arrays.faces].all(1)].astype(np.int64)

    def vertices(self, identity: Float[np.ndarray, "I"]) -> Float[np.ndarray, "V 3"]:
        """The whole embedded head at rest."""
        return self._template + self._all_directions @ identity

    def points(self, placed: Float[np.ndarray, "V 3"]) -> SkinPoints:
        """The face's vertices, where the head's are placed."""
        return skin_points(self._arrays, placed).select(self.rows)

    def bending(self) -> sparse.csc_matrix:
        """How far each vertex moves unlike its neighbours, squared: the graph's Laplacian."""
        row = np.full(len(self._template), -1)
        row[self.rows] = np.arange(len(self.rows))
        ends = row[self._skin_faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]
        a, b = ends[(ends >= 0).all(1)].T
        count = len(self.rows)
        near = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)).tocsc()
        near = ((near + near.T) > 0).astype(np.float64)
        degree = np.maximum(np.asarray(near.sum(1)).reshape(-1), 1.0)
        laplacian = sparse.eye(count) - sparse.diags(1 / degree) @ near
        return (laplacian.T @ laplacian).tocsc()


def _fit_person(
    face: _Face, surface: SkinSurface, eyes: Float[np.ndarray, "2 3"]
) -> tuple[SimilarityTransform, Float[np.ndarray, "I"]]:
    """Gauss-Newton on pose, size and identity; what belongs together is looked for in each step."""
    apart = np.linalg.norm(eyes[0] - eyes[1]) / np.linalg.norm(face.eyes[0] - face.eyes[1])
    shift_m = eyes.mean(0) - apart * face.eyes.mean(0)
    pose = SimilarityTransform(float(apart), np.eye(3), shift_m)
    identity = np.zeros(face.directions.shape[-1])
    for number, reach_m in enumerate(_REACH_M):
        points = face.points(pose(face.vertices(identity)))
        found, unlike_m = surface.sampled(points)
        weight = face.weight / (1 + (unlike_m / reach_m) ** 2) ** 2
        off = np.einsum("vx,vx->v", found.normals, points.points - found.points)
        slopes = _slopes(pose, points.points, face.directions)
        rows = np.einsum("vx,vxq->vq", found.normals, slopes)
        own_eyes = pose(face.eyes + face.eye_directions @ identity)
        eye_rows = _slopes(pose, own_eyes, face.eye_directions).reshape(6, -1)
        hessian = rows.T @ (weight[:, None] * rows) + _EYE_WEIGHT * eye_rows.T @ eye_rows
        gradient = rows.T @ (weight * off)
        gradient += _EYE_WEIGHT * eye_rows.T @ (own_eyes - eyes).reshape(6)
        prior = np.r_[np.zeros(7), np.full(len(identity), _IDENTITY_WEIGHT * _SIGMA_M**2)]
        gradient += prior * np.r_[np.zeros(7), identity]
        # First pose and size alone: a person would take over what they have to explain.
        free = 7 if number < len(_REACH_M) // 3 else len(gradient)
        step = np.zeros(len(gradient))
        damped = hessian + np.diag(prior + _DAMPING * np.trace(hessian))
        step[:free] = -np.linalg.solve(damped[:free, :free], gradient[:free])
        pose = pose.moved(step[:7].clip(-_LONGEST_STEP, _LONGEST_STEP))
        identity = identity + step[7:]
    return pose, identity


def _slopes(
    pose: SimilarityTransform,
    points: Float[np.ndarray, "N 3"],
    directions: Float[np.ndarray, "N 3 I"],
) -> Float[np.ndarray, "N 3 Q"]:
    """Derivatives of posed points to `SimilarityTransform.moved`'s step, then to the identity."""
    own = pose.scale * np.einsum("xy,nyi->nxi", pose.turn, directions)
    return np.concatenate([similarity_slopes(points), own], axis=-1)


def similarity_slopes(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 7"]:
    """Derivatives of points to a turn, a shift and a growth (log) about the origin."""
    turned = np.cross(np.eye(3)[:, None], points).transpose(1, 2, 0)
    shifted = np.broadcast_to(np.eye(3), turned.shape)
    return np.concatenate([turned, shifted, points[..., None]], axis=-1)


def _close_the_rest(
    face: _Face, surface: SkinSurface, placed: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 3"]:
    """The face drawn onto the surface by a displacement that is as smooth as can be."""
    placed = placed.copy()
    start = placed[face.rows]
    bending = sparse.kron(face.bending(), sparse.eye(3), format="csc")
    for stiffness in _STIFFNESS:
        places = surface.nearest(face.points(placed))
        weight = face.weight / (1 + (places.unlike_m / _REACH_M[-1]) ** 2) ** 2
        normals = places.found.normals
        pull = np.einsum("vx,vy->vxy", normals, normals) + _ALONG * np.eye(3)
        pull *= weight[:, None, None]
        wanted = np.einsum("vxy,vy->vx", pull, places.found.points - start).reshape(-1)
        places_in = np.arange(len(pull) + 1)
        blocks = sparse.csc_matrix(sparse.bsr_matrix((pull, places_in[:-1], places_in)))
        system = (blocks + stiffness * bending).tocsc()
        factors = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        placed[face.rows] = start + factors.solve(wanted).reshape(-1, 3)
    return placed
