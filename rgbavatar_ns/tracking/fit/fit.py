"""Fit of the head model to a clip's landmarks: identity and camera once, then every frame."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.landmark_cost import FrameCost, FrameTerms, Target
from rgbavatar_ns.tracking.fit.levenberg_marquardt import (
    Evaluation,
    QuadraticModel,
    levenberg_marquardt,
)
from rgbavatar_ns.tracking.fit.outline import OutlineCost, OutlineTerms, PersonOutline

_Values = Float[np.ndarray, "P"]
_Packed = Float[np.ndarray, "Q"]

# Heights of the face: heads come to stand .9 to .95 m from the camera, from where FaceMesh's points
# of real people look as if seen, wherever the camera is (benchmarks/quality/camera_distance.py).
_FOCAL_BY_FACE = 5.8
# Longer sides of the picture: faces that ask for a wider lens are taken to be farther away.
_WIDEST = 0.7
_IDENTITY_WIDTH = 1.0  # principal components, of variance 1
# Of them in depth, beside that, once a frame: from in front landmarks hardly show a face's depth,
# and what they err by is mostly the same in all of a person's frames, so that twelve tell of it
# little more than one. Ours, from the profile of a real speaker.
_DEPTH_WIDTH = 0.5
_HEAD_HEIGHT_M = 0.19
_BLOCK_FRAMES = 256
_OFFSET_SHRINK = 0.8
# Steps towards a frame from the one before it, and from a pose that fits already; from nowhere,
# where a clip or a stream begins or a face comes back; and for key frames, whose person is unknown.
# Each first with the loss that finds the head from afar, then with the one that lets go.
STEPS_ONWARD, _STEPS_AGAIN, STEPS_ANEW, _STEPS_KEY = (4, 2), (0, 2), (17, 8), (10, 5)
# From afar a fit need only come near: it stops when a step lowers the cost by less than this share.
_NEAR_ENOUGH, _SETTLED = 1e-2, 1e-3
# Steps with the outlines: first into them, then with hair of one thickness, found anew each time.
_INTO_OUTLINE_STEPS, _HAIR_STEPS, _HAIR_ROUNDS = 10, 4, 3


@dataclass(frozen=True)
class SubjectFit:
    """What is the same in all frames."""

    identity: Float[np.ndarray, "I"]
    camera: StillCamera
    key_values: Float[np.ndarray, "K P"]


@dataclass(frozen=True)
class ClipFit:
    """Every frame's fitted theta entries and what is shared."""

    subject: SubjectFit
    values: Float[np.ndarray, "F P"]
    upon_body: Float[np.ndarray, "F H"] | None = None
    """theta of the same heads upon a body, where that was found."""

    def without(self, rejected: Sequence[int]) -> "ClipFit":
        """The same without the given positions."""
        upon_body = self.upon_body
        if upon_body is not None:
            upon_body = np.delete(upon_body, list(rejected), axis=0)
        values = np.delete(self.values, list(rejected), axis=0)
        return replace(self, values=values, upon_body=upon_body)


def fit_subject(
    cost: FrameCost,
    keys: Sequence[Target],
    width: int,
    height: int,
    identity_components: int,
    focal_px: float,
) -> SubjectFit:
    """Identity from key frames, at the distance that their faces' size says."""
    camera = initial_camera(keys, focal_px, (width / 2, height / 2))
    return _fit_keys(cost, keys, camera, identity_components, 15)


def usual_focal_px(face_px: float, width: int, height: int) -> float:
    """The focal length by which faces of such a height are as far off as FaceMesh's points look."""
    return max(face_px * _FOCAL_BY_FACE, max(width, height) * _WIDEST)


def initial_camera(
    keys: Sequence[Target], focal_px: float, center_px: tuple[float, float]
) -> StillCamera:
    """A camera at the distance at which a usual head has the observed size."""
    face = float(np.median([key.face_height_px for key in keys]))
    return StillCamera(focal_px, center_px, focal_px * _HEAD_HEIGHT_M / face)


def rigid_start(cost: FrameCost, camera: StillCamera, target: Target) -> _Values:
    """Frontal pose whose landmarks' centre lies on the observed one."""
    base = np.zeros(cost.head.layout.size)
    points = cost.head.points(base, np.zeros(cost.head.num_identity), camera.eye_m)
    depth = camera.distance_m - points[:, 2].mean()
    wanted = (target.points_px.mean(0) - camera.center_px) * depth / camera.focal_px
    shift = np.array([wanted[0], -wanted[1]]) - points[:, :2].mean(0)
    translation = cost.head.layout.slice("translation")
    base[translation.start : translation.start + 2] = shift
    return base[cost.parameters.columns]


def fit_frame(
    cost: FrameCost,
    camera: StillCamera,
    target: Target,
    start: _Values,
    neighbours: _Values | None,
    temporal_weight: float,
    steps: tuple[int, int],
) -> _Values:
    """One frame's bounded fit from `start`, drawn towards `neighbours` if given.

    At most so many `steps` with each loss: the first one finds the head from afar, the second one
    lets go of landmarks that are far off.
    """
    identity, values = np.zeros(cost.head.num_identity), start
    for most, redescending in zip(steps, (False, True)):
        if not most:
            continue
        frame = FrameTerms(target, camera, redescending, neighbours, temporal_weight)
        values = levenberg_marquardt(
            partial(cost.at, identity=identity, frame=frame),
            values,
            cost.parameters.lower,
            cost.parameters.upper,
            iterations=most,
            tolerance=_SETTLED if redescending else _NEAR_ENOUGH,
        )
    return values


def fit_key(cost: FrameCost, camera: StillCamera, target: Target) -> _Values:
    """One key frame's fit by itself, for the average person."""
    start = rigid_start(cost, camera, target)
    return fit_frame(cost, camera, target, start, None, 0.0, _STEPS_KEY)


def fit_clip(
    cost: FrameCost,
    subject: SubjectFit,
    targets: Sequence[Target],
    follows: Sequence[bool],
    temporal_weight: float,
    explains: Callable[[int, _Values], bool],
    advance: Callable[[], None] = lambda: None,
) -> ClipFit:
    """Every frame: once forward, starting from the frame before, then once more with neighbours.

    `follows[i]` says that frame i comes directly after frame i - 1. The second pass draws each
    frame to the mean of both neighbours, so smoothing has no lag; a gap is never bridged.
    `explains` tells whether such values explain a frame's landmarks: one that nothing explains, as
    of a hand before the face, is nobody's start and no neighbour.
    """
    person = replace(cost, head=cost.head.of_person(subject.identity))
    values: list[np.ndarray] = []
    told: list[bool] = []
    for number, target in enumerate(targets):
        begun, steps = rigid_start(person, subject.camera, target), STEPS_ANEW
        if number and follows[number] and told[-1]:
            begun, steps = values[-1], STEPS_ONWARD
        values.append(fit_frame(person, subject.camera, target, begun, None, 0.0, steps))
        told.append(explains(number, values[-1]))
        if not told[-1] and steps is STEPS_ONWARD:  # The one before may have led astray.
            begun = rigid_start(person, subject.camera, target)
            values[-1] = fit_frame(person, subject.camera, target, begun, None, 0.0, STEPS_ANEW)
            told[-1] = explains(number, values[-1])
        advance()
    for number, target in enumerate(targets):
        near = []
        if number and follows[number] and told[number - 1]:
            near.append(values[number - 1])
        if number + 1 < len(targets) and follows[number + 1] and told[number + 1]:
            near.append(values[number + 1])
        if near and told[number] and temporal_weight > 0:
            middle = np.mean(near, axis=0)
            values[number] = fit_frame(
                person,
                subject.camera,
                target,
                values[number],
                middle,
                temporal_weight,
                _STEPS_AGAIN,
            )
        advance()
    return ClipFit(subject, np.array(values))


def subject_offsets(
    cost: FrameCost, subject: SubjectFit, keys: Sequence[Target]
) -> Float[np.ndarray, "L 3"]:
    """Constant disagreement of each landmark with the mesh, as an offset at rest, metres.

    FaceMesh's idea of a point and the mesh's differ from subject to subject by a little; what is
    the same in all key frames is no expression. The median over key frames, shrunk.
    """
    found = []
    for values, target in zip(subject.key_values, keys):
        theta = cost.theta(values)
        points = cost.head.points(theta, subject.identity, subject.camera.eye_m)
        residual = subject.camera.project(points) - target.points_px
        depth = subject.camera.distance_m - points[:, 2]
        across = -residual * (1.0, -1.0) * (depth / subject.camera.focal_px)[:, None]
        shift = np.concatenate([across, np.zeros((len(across), 1))], axis=1)
        found.append(shift @ cost.head.head_rotation(theta))
    return _OFFSET_SHRINK * np.median(found, axis=0)


def fit_outlines(
    cost: FrameCost,
    outline_cost: OutlineCost,
    keys: Sequence[Target],
    outlines: Sequence[PersonOutline | None],
    subject: SubjectFit,
    identity_components: int,
) -> SubjectFit:
    """The subject of `fit_subject`, moved to where the key frames' outlines allow it to be.

    `outline_cost` has this cost's entries and identity components. Outlines go with `keys`; None
    where a frame has none. The camera stays.
    """
    camera, terms = subject.camera, dict[int, OutlineTerms]()
    for number, (outline, key) in enumerate(zip(outlines, keys)):
        if outline is not None:
            frame = OutlineTerms(outline, camera, key.to_upright)
            theta = cost.theta(subject.key_values[number])
            if outline_cost.tells(theta, subject.identity, frame):
                terms[number] = frame
    if not terms:
        return subject
    for rounds in range(1 + _HAIR_ROUNDS):
        if rounds:
            thetas = [cost.theta(subject.key_values[number]) for number in terms]
            hair_m = outline_cost.hair_m(thetas, subject.identity, list(terms.values()))
            terms = {number: replace(one, hair_m=hair_m) for number, one in terms.items()}
        subject = _fit_keys(
            cost,
            keys,
            camera,
            identity_components,
            _HAIR_STEPS if rounds else _INTO_OUTLINE_STEPS,
            subject.key_values,
            subject.identity,
            (outline_cost, terms),
        )
    return subject


def _fit_keys(
    cost: FrameCost,
    keys: Sequence[Target],
    camera: StillCamera,
    identity_components: int,
    iterations: int,
    starts: Float[np.ndarray, "K P"] | None = None,
    identity: Float[np.ndarray, "I"] | None = None,
    outlines: tuple[OutlineCost, Mapping[int, OutlineTerms]] | None = None,
) -> SubjectFit:
    """Fit all key frames and the person together, from `starts` and `identity` (the average)."""
    if starts is None:
        starts = np.array([fit_key(cost, camera, key) for key in keys])
    terms = [FrameTerms(key, camera) for key in keys]
    frames, size = len(keys), len(cost.parameters.columns)
    shared = min(identity_components, cost.head.num_identity)
    joint = replace(cost, identity_columns=shared)
    precision = _IDENTITY_WIDTH**-2.0 * np.eye(shared)
    precision += frames * _DEPTH_WIDTH**-2.0 * cost.head.depth_share(shared)
    lower = np.concatenate([np.tile(cost.parameters.lower, frames), np.full(shared, -3.0)])
    upper = np.concatenate([np.tile(cost.parameters.upper, frames), np.full(shared, 3.0)])
    common = slice(frames * size, frames * size + shared)

    def unpacked(packed: _Packed) -> tuple[np.ndarray, np.ndarray]:
        """Each frame's values, and the person."""
        person = np.zeros(cost.head.num_identity)
        person[:shared] = packed[common]
        return packed[: common.start].reshape(frames, size), person

    def evaluations(packed: _Packed) -> list[tuple[int, Evaluation]]:
        """What each frame costs, by its landmarks and by its outline."""
        values, person = unpacked(packed)
        found = [(k, joint.at(own, person, terms[k])) for k, own in enumerate(values)]
        if outlines is not None:
            outline_cost, seen = outlines
            for k, outline in seen.items():
                found.append((k, outline_cost.at(cost.theta(values[k]), person, outline)))
        return found

    def evaluate(packed: _Packed) -> Evaluation:
        found, pull = evaluations(packed), precision @ packed[common]
        total = 0.5 * float(pull @ packed[common]) + sum(one.cost for _, one in found)

        def model() -> QuadraticModel:
            gradient, hessian = np.zeros(len(packed)), np.zeros((len(packed), len(packed)))
            gradient[common] = pull
            hessian[common, common] = precision
            for number, one in found:
                own, part = slice(number * size, (number + 1) * size), one.model()
                gradient[own] += part.gradient[:size]
                gradient[common] += part.gradient[size:]
                hessian[own, own] += part.hessian[:size, :size]
                hessian[own, common] += part.hessian[:size, size:]
                hessian[common, own] += part.hessian[size:, :size]
                hessian[common, common] += part.hessian[size:, size:]
            return QuadraticModel(total, gradient, hessian)

        return Evaluation(total, model)

    begun = np.zeros(shared) if identity is None else identity[:shared]
    packed = levenberg_marquardt(
        evaluate,
        np.concatenate([starts.reshape(-1), begun]),
        lower,
        upper,
        iterations=iterations,
        tolerance=1e-3,
    )
    values, found = unpacked(packed)
    return SubjectFit(found, camera, values)


def key_frame_positions(
    landmarks_px: Float[np.ndarray, "F L 2"],
    count: int,
    among: Int[np.ndarray, "A"] | None = None,
) -> list[int]:
    """Frames that differ most from each other: farthest-point choice over aligned landmarks.

    Starts from the frame nearest to the median shape; deterministic. Fewer where fewer differ.
    `among` are the positions to choose from, all by default.
    """
    frames = np.arange(len(landmarks_px)) if among is None else among
    # Of a long film one more array of all landmarks is much memory.
    blocks = np.split(frames, range(_BLOCK_FRAMES, len(frames), _BLOCK_FRAMES))
    means = np.concatenate([landmarks_px[block].mean(1) for block in blocks])

    def away(other: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, "F"]:
        """Squared distances of all shapes from one."""
        found, start = [], 0
        for block in blocks:
            shapes = landmarks_px[block] - means[start : start + len(block), None]
            found.append(np.square(shapes - other).reshape(len(block), -1).sum(1))
            start += len(block)
        return np.concatenate(found)

    def shape(row: int) -> Float[np.ndarray, "L 2"]:
        return landmarks_px[frames[row]] - means[row]

    marks = range(landmarks_px.shape[1])
    median = np.array([np.median(landmarks_px[frames, mark] - means, axis=0) for mark in marks])
    chosen = [int(away(median).argmin())]
    nearest = away(shape(chosen[0]))
    while len(chosen) < min(count, len(frames)) and nearest.max() > 0:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, away(shape(chosen[-1])))
    return sorted(frames[chosen].tolist())
