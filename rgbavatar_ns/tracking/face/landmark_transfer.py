"""FaceMesh's points, their response and closing lids carried from the embedded head to another."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import trimesh
from jaxtyping import Float, Int

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.joints import EYES, JAW
from rgbavatar_ns.head.landmarks import (
    UNSURE_M,
    LandmarkMap,
    LandmarkNoise,
    LandmarkResponse,
    facemesh_landmarks,
    facemesh_noise,
    facemesh_response,
)
from rgbavatar_ns.head.registration import Registration, register, similarity_slopes
from rgbavatar_ns.head.skin_surface import SkinSurface, is_skin, skin_points

# Landmark displacements are told apart to this much; coefficients are of the order of one.
_NOISE_M = 0.0005
# Directions to the camera for which the response to the view is carried over: within 45 degrees.
_VIEWS, _WIDEST_VIEW = 9, 0.7


@dataclass(frozen=True)
class FittedHead:
    """A head with what a tracker has to know about it."""

    arrays: HeadArrays
    landmarks: LandmarkMap
    response: LandmarkResponse
    """Row for row of `landmarks`. Its expression part goes on with the eyelids, if the head has
    any, as the head's coefficients do."""
    noise: LandmarkNoise
    """Rows are FaceMesh indices."""


def fitted_head(head: HeadArrays) -> FittedHead:
    """What a tracker needs of a head of any topology, by laying the embedded head over it.

    A head without eyelid offsets and without named expressions gets the embedded head's blinks as
    its eyelids. Raises UserError for a head without a face or without eyeballs.
    """
    eyeballs = [_eyeball(head, joint) for joint in EYES]
    registration = register(head)
    blinks = any(name.startswith("eyeBlink") for name in head.expression_names)
    if head.eyelid_dirs is None and not blinks:
        head = replace(head, eyelid_dirs=carried_blinks(head, registration))
    landmarks = carried_landmarks(head, eyeballs, registration)
    response = carried_response(head, landmarks, registration)
    return FittedHead(head, landmarks, response, carried_noise(landmarks))


def carried_landmarks(
    head: HeadArrays, eyeballs: Sequence[Int[np.ndarray, "_"]], registration: Registration
) -> LandmarkMap:
    """The points of `facemesh_landmarks` on another head, in the same order.

    `eyeballs` are the triangles of the left and the right one. Points of the skin go to the nearest
    skin of like normal and jaw weight; the iris' points to where the same direction from the eye's
    joint leaves the other eyeball, since both heads look along +z at rest. How far a point had to
    go is added to its spread.
    """
    embedded, marks = HeadArrays.embedded(), facemesh_landmarks()
    triangle, barycentric = marks.triangle.copy(), marks.barycentric.copy()
    corners = embedded.faces[marks.triangle]
    eye_share = _at(marks, embedded, embedded.skinning_weights.astype(np.float64))[:, EYES]
    on_skin = np.flatnonzero(eye_share.max(1) < 0.5)
    points = skin_points(embedded, registration.placed).between(corners, marks.barycentric)
    places = SkinSurface(head).nearest(points.select(on_skin))
    triangle[on_skin], barycentric[on_skin] = places.triangle, places.barycentric
    spread_m = marks.spread_m.copy()
    spread_m[on_skin] = np.hypot(spread_m[on_skin], places.unlike_m)
    at_rest = _at(marks, embedded, embedded.v_template.astype(np.float64))
    for column, joint in enumerate(EYES):
        rows = np.flatnonzero(eye_share[:, column] >= 0.5)
        center = embedded.joint_regressor[joint].astype(np.float64) @ embedded.v_template
        triangle[rows], barycentric[rows] = _on_eyeball(
            head, joint, eyeballs[column], at_rest[rows] - center
        )
    return replace(marks, triangle=triangle, barycentric=barycentric, spread_m=spread_m)


def carried_noise(landmarks: LandmarkMap) -> LandmarkNoise:
    """FaceMesh's noise, larger where `landmarks`, carried over, are less sure of their place."""
    noise, known = facemesh_noise(), facemesh_landmarks().spread_m
    own_share = noise.own_share.copy()
    ratio = (UNSURE_M**2 + landmarks.spread_m**2) / (UNSURE_M**2 + known**2)
    own_share[landmarks.facemesh_index] *= np.sqrt(ratio)
    return replace(noise, own_share=own_share)


def _eyeball(head: HeadArrays, joint: int) -> Int[np.ndarray, "_"]:
    """The triangles that turn with an eye's joint."""
    of_eye = head.skinning_weights[:, joint] > 0.5
    triangles = np.flatnonzero(of_eye[head.faces].all(1))
    if not len(triangles):
        raise UserError(
            f"The head model '{head.name}' has no eyeballs that turn with its eye joints.",
            "Name a head with eyeballs, as FLAME has, or track with the embedded head.",
        )
    return triangles


def _on_eyeball(
    head: HeadArrays,
    joint: int,
    triangles: Int[np.ndarray, "_"],
    directions: Float[np.ndarray, "N 3"],
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """Triangles and places where directions from an eye's joint leave its eyeball."""
    vertices = head.v_template.astype(np.float64)
    corners = vertices[head.faces[triangles]]
    center = head.joint_regressor[joint].astype(np.float64) @ vertices
    outward = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    radius = np.linalg.norm(corners - center, axis=2).max()
    rows, places = [], []
    for ahead in center + radius * outward:
        closest = trimesh.triangles.closest_point(corners, np.tile(ahead, (len(corners), 1)))
        row = int(np.linalg.norm(closest - ahead, axis=1).argmin())
        place = trimesh.triangles.points_to_barycentric(corners[[row]], closest[[row]])[0]
        rows.append(triangles[row])
        places.append(place.clip(0, 1) / place.clip(0, 1).sum())
    return np.array(rows), np.array(places)


def carried_blinks(head: HeadArrays, registration: Registration) -> Float[np.ndarray, "V 3 2"]:
    """Offsets that close the left and the right eye of another head, as the embedded one's do."""
    embedded = HeadArrays.embedded()
    skin = np.flatnonzero(is_skin(head))
    placed = replace(embedded, v_template=registration.placed.astype(np.float32))
    places = SkinSurface(placed).nearest(skin_points(head).select(skin))
    lids = np.zeros((len(head.v_template), 3, 2), dtype=np.float32)
    corners = embedded.faces[places.triangle]
    to_head = registration.pose.scale * registration.pose.turn
    for column, side in enumerate(("Left", "Right")):
        blink = embedded.num_identity + embedded.expression_names.index(f"eyeBlink{side}")
        moved = np.einsum("nk,nkx->nx", places.barycentric, embedded.shapedirs[corners, :, blink])
        lids[skin, :, column] = moved @ to_head.T
    return lids


def carried_response(
    head: HeadArrays, landmarks: LandmarkMap, registration: Registration
) -> LandmarkResponse:
    """`facemesh_response` for another head.

    What depends on the view, the jaw and the gaze is turned and scaled to the other head. What
    depends on expressions and the person is a function of how these move the landmarks: each
    direction of the other head is written as the embedded head's (ridge regression over the
    landmarks), and answered as they are. The person that the other head is at rest goes into
    `rest`.
    """
    own, marks, embedded = facemesh_response(), facemesh_landmarks(), HeadArrays.embedded()
    pose = registration.pose
    count = embedded.num_identity
    known = _at(marks, embedded, embedded.shapedirs.astype(np.float64))
    points = _at(marks, embedded, embedded.v_template.astype(np.float64))
    opened = _jaw_slopes(embedded, marks, points)
    lids = () if head.eyelid_dirs is None else (head.eyelid_dirs.astype(np.float64),)
    directions = np.concatenate([head.shapedirs.astype(np.float64), *lids], axis=2)
    other = np.einsum("yx,lyc->lxc", pose.turn, _at(landmarks, head, directions)) / pose.scale
    identity, expression = np.split(other, [head.num_identity], axis=2)
    # Of another person a turn, a shift and a growth say nothing: pose and size answer for them.
    no_answer = np.zeros((*points.shape, 7))
    person = _answered(
        identity,
        np.concatenate([known[..., :count], similarity_slopes(points)], -1),
        np.concatenate([own.identity, no_answer], -1),
    )
    acted = _answered(
        expression,
        np.concatenate([known[..., count:], opened[..., None]], -1),
        np.concatenate([own.expression, own.jaw_open[..., None]], -1),
    )
    constant, view = _turned_view(own.view, pose.turn)
    rest = own.rest + own.identity @ registration.identity + constant
    parts = LandmarkResponse(rest, view, acted, own.jaw_open, own.gaze, person)
    to_head = pose.scale * pose.turn
    return LandmarkResponse(
        *(np.einsum("xy,ly...->lx...", to_head, getattr(parts, item.name)) for item in fields(own))
    )


def _answered(
    directions: Float[np.ndarray, "L 3 O"],
    known: Float[np.ndarray, "L 3 K"],
    answers: Float[np.ndarray, "L 3 K"],
) -> Float[np.ndarray, "L 3 O"]:
    """The answers to directions, which are written as mixtures of known ones."""
    basis = known.reshape(-1, known.shape[-1])
    normal = basis.T @ basis + len(basis) * _NOISE_M**2 * np.eye(basis.shape[1])
    shares = np.linalg.solve(normal, basis.T @ directions.reshape(len(basis), -1))
    return answers @ shares


def _jaw_slopes(
    head: HeadArrays, marks: LandmarkMap, points: Float[np.ndarray, "L 3"]
) -> Float[np.ndarray, "L 3"]:
    """How the landmarks move as the jaw begins to open, metres a radian."""
    pivot = head.joint_regressor[JAW].astype(np.float64) @ head.v_template
    share = _at(marks, head, head.skinning_weights.astype(np.float64))[:, JAW, None]
    return share * np.cross([1.0, 0.0, 0.0], points - pivot)


def _turned_view(
    view: Float[np.ndarray, "L 3 5"], turn: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "L 3"], Float[np.ndarray, "L 3 5"]]:
    """Constant and slopes of a response to the view for a head whose axes are turned."""
    x, y = np.stack(np.meshgrid(*[np.linspace(-_WIDEST_VIEW, _WIDEST_VIEW, _VIEWS)] * 2)).reshape(
        2, -1
    )
    ahead = x**2 + y**2 <= _WIDEST_VIEW**2
    x, y = x[ahead], y[ahead]
    theirs = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=1)
    ours = theirs @ turn
    terms = np.concatenate([np.ones((len(theirs), 1)), _view_terms(theirs)], axis=1)
    mixed, *_ = np.linalg.lstsq(terms, _view_terms(ours), rcond=None)
    turned = view @ mixed.T
    return turned[..., 0], turned[..., 1:]


def _view_terms(directions: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 5"]:
    x, y, _ = directions.T
    return np.stack([x, y, x * x, y * y, x * y], axis=1)


def _at(
    marks: LandmarkMap, head: HeadArrays, values: Float[np.ndarray, "V *rest"]
) -> Float[np.ndarray, "L *rest"]:
    """Values of vertices at the landmarks."""
    return np.einsum("lk,lk...->l...", marks.barycentric, values[head.faces[marks.triangle]])
