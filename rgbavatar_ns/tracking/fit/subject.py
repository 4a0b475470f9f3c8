"""The head model fitted to one speaker: the landmark map, its weights, the stages of the fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.landmarks import (
    SPARSE_51,
    LandmarkMap,
    LandmarkNoise,
    LandmarkResponse,
    facemesh_landmarks,
    facemesh_noise,
    facemesh_response,
)
from rgbavatar_ns.threads import using_threads
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.detector import (
    FACE_OVAL,
    IRIS_CENTERS,
    LID_PAIRS,
    LIP_PAIRS,
    eye_widths_px,
    face_height_px,
    irises_seen,
    upright_turn,
)
from rgbavatar_ns.tracking.face.iris import FoundIrises
from rgbavatar_ns.tracking.fit.fit import (
    ClipFit,
    SubjectFit,
    fit_clip,
    fit_key,
    fit_outlines,
    fit_subject,
    initial_camera,
    key_frame_positions,
    subject_offsets,
    usual_focal_px,
)
from rgbavatar_ns.tracking.fit.irises import iris_places
from rgbavatar_ns.tracking.fit.landmark_cost import FrameCost, Target
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead
from rgbavatar_ns.tracking.fit.outline import OutlineCost, PersonOutline
from rgbavatar_ns.tracking.fit.parameters import fit_parameters

# Lips, lids, brows, nose and irises are seen; cheeks and forehead are interpolated by FaceMesh,
# so every fourth of those points does. The outline slides over the skin as the head turns, but
# without it the pitch of the head is badly known: on renders the error halves with it.
_SEEN = {*SPARSE_51, *FACE_OVAL, *IRIS_CENTERS, *range(0, IRIS_CENTERS[0], 4)}
_SEEN |= {index for pair in LIP_PAIRS + LID_PAIRS for index in pair}
# A frame whose landmarks the head cannot follow to this share of the face's height is left out.
_REJECT_SHARE = 0.06
# So many frames are judged for each key frame, at most: one costs as much as to fit a frame anew.
_MOST_JUDGED = 10


@dataclass
class SubjectTracker:
    """Fits the head to a clip; after `fit` it knows the subject's landmark offsets too."""

    head: HeadModel
    config: TrackConfig
    landmarks: LandmarkMap = field(default_factory=facemesh_landmarks)
    """Where FaceMesh's points lie on this head; by default on the embedded one."""
    response: LandmarkResponse | None = field(default_factory=facemesh_response)
    """How they follow it, row for row of `landmarks`; None takes them to stay on the skin."""
    noise: LandmarkNoise = field(default_factory=facemesh_noise)
    """How they err beside; rows are FaceMesh indices."""

    def __post_init__(self) -> None:
        rows = np.flatnonzero(np.isin(self.landmarks.facemesh_index, sorted(_SEEN)))
        marks = self.landmarks.select(rows)
        self.facemesh_index = marks.facemesh_index
        # After FaceMesh's points the irises that are found in the picture, which lie on the mesh.
        irises, places = iris_places(self.head.arrays)
        vertex_ids = self.head.arrays.faces[marks.triangle].astype(np.int64)
        self.mesh_landmarks = LandmarkHead(
            self.head,
            np.concatenate([vertex_ids, irises]),
            np.concatenate([marks.barycentric, places]),
        )
        size_m = self.mesh_landmarks.expression_size_m()
        names, layout = self.head.arrays.expression_names, self.head.layout
        parameters = fit_parameters(layout, names, size_m)
        seen = self.mesh_landmarks
        if self.response is not None:
            seen = seen.with_response(self.response.select(rows).and_none(len(irises)))
        self._seen = seen
        self._person = _AsTensor()
        noise = self.noise.select(np.array([*marks.facemesh_index, *IRIS_CENTERS]))
        self.cost = FrameCost(seen, noise, parameters)

    def targets(
        self, landmarks_px: Float[np.ndarray, "F 478 2"], irises: FoundIrises | None = None
    ) -> list[Target]:
        """Each frame's landmarks in the order of the landmark head, irises found (px) at the end.

        Without found ones FaceMesh's tell the gaze.
        """
        heights, turns = face_height_px(landmarks_px), upright_turn(landmarks_px)
        irises = FoundIrises.unseen(landmarks_px) if irises is None else irises
        points = np.concatenate([landmarks_px[:, self.facemesh_index], irises.centers], axis=1)
        seen, found = np.ones(points.shape[:2]), slice(len(self.facemesh_index), None)
        guessed = [int(np.flatnonzero(self.facemesh_index == iris)[0]) for iris in IRIS_CENTERS]
        seen[:, guessed] = irises_seen(landmarks_px) * ~irises.found
        seen[:, found] = irises.found
        own_share = np.broadcast_to(self.cost.noise.own_share[:, None], points.shape).copy()
        as_found = irises.sigma * (eye_widths_px(landmarks_px) / heights[:, None])[..., None]
        own_share[:, found] = np.where(irises.found[..., None], as_found, own_share[:, found])
        return [
            Target(one, own, float(height), turn, counts)
            for one, own, height, turn, counts in zip(points, own_share, heights, turns, seen)
        ]

    def fit(
        self,
        landmarks_px: Float[np.ndarray, "F 478 2"],
        follows: Sequence[bool],
        width: int,
        height: int,
        advance: Callable[[], None] = lambda: None,
        keys: Sequence[int] | None = None,
        outlines: Sequence[PersonOutline | None] = (),
        irises: FoundIrises | None = None,
    ) -> ClipFit:
        """Identity, camera and offsets from key frames, then every frame.

        `keys` are `key_positions`, where they are known; `outlines` those of the person in these
        frames, in their order; `irises` those found in the pictures, in pixels.
        """
        # The matrices are small: more threads would only wait for each other.
        with threadpool_limits(1):
            subject = self.fit_subject(landmarks_px, width, height, keys, outlines, irises)
            targets = self.targets(landmarks_px, irises)

            def explains(number: int, values: Float[np.ndarray, "P"]) -> bool:
                one = ClipFit(subject, values[None])
                return not self.rejected(one, landmarks_px[number : number + 1])

            weight = self.config.temporal_weight
            return fit_clip(self.cost, subject, targets, follows, weight, explains, advance)

    def key_positions(
        self, landmarks_px: Float[np.ndarray, "F 478 2"], width: int, height: int
    ) -> list[int]:
        """The frames that the subject is fitted on: those that differ most, of those that a head
        explains.

        What is found of a hand before the face differs most of all, and would make the person.
        Each frame is judged by itself and for the average person, so that the bound is at least
        twice what the most usual frame has.
        """
        count, left = self.config.key_frames, np.arange(len(landmarks_px))
        misfits = self._misfits_alone(
            landmarks_px, key_frame_positions(landmarks_px, 1), width, height
        )
        bound = max(_REJECT_SHARE, 2 * min(misfits.values()))
        while True:
            chosen = key_frame_positions(landmarks_px, count, left)
            unknown = [position for position in chosen if position not in misfits]
            misfits |= self._misfits_alone(landmarks_px, unknown, width, height)
            poor = [position for position in chosen if misfits[position] > bound]
            if not poor:
                return chosen
            left = np.setdiff1d(left, poor)
            if len(misfits) > _MOST_JUDGED * count:
                left = np.array(sorted(k for k, misfit in misfits.items() if misfit <= bound))

    def _misfits_alone(
        self,
        landmarks_px: Float[np.ndarray, "F 478 2"],
        positions: Sequence[int],
        width: int,
        height: int,
    ) -> dict[int, float]:
        """How far the average person's head stays from the landmarks of each of these frames."""
        targets = self.targets(landmarks_px[list(positions)])
        if not targets:
            return {}
        camera = initial_camera(
            targets, self._focal_px(landmarks_px, width, height), (width / 2, height / 2)
        )
        values = np.array([fit_key(self.cost, camera, target) for target in targets])
        average = np.zeros(self.cost.head.num_identity)
        fit = ClipFit(SubjectFit(average, camera, values), values)
        return dict(zip(positions, self._misfits(fit, landmarks_px[list(positions)]).tolist()))

    def fit_subject(
        self,
        landmarks_px: Float[np.ndarray, "F 478 2"],
        width: int,
        height: int,
        keys: Sequence[int] | None = None,
        outlines: Sequence[PersonOutline | None] = (),
        irises: FoundIrises | None = None,
    ) -> SubjectFit:
        """Identity, camera and landmark offsets from the key frames.

        `keys`, `outlines` and `irises` as in `fit`; without any, landmarks alone decide.
        """
        positions = self.key_positions(landmarks_px, width, height) if keys is None else list(keys)
        key_irises = None if irises is None else irises.of(positions)
        targets = self.targets(landmarks_px[positions], key_irises)
        shared = min(self.config.identity_components, self.cost.head.num_identity)
        focal_px = self._focal_px(landmarks_px, width, height)
        subject = fit_subject(self.cost, targets, width, height, shared, focal_px)
        if outlines:
            outline_cost = OutlineCost(self.head, self.cost.parameters.columns, shared)
            subject = fit_outlines(self.cost, outline_cost, targets, outlines, subject, shared)
        offsets = subject_offsets(self.cost, subject, targets)
        # An iris that is seen is where the mesh's is to be.
        offsets[len(self.facemesh_index) :] = 0
        self.cost = replace(self.cost, head=self.cost.head.with_offsets(offsets))
        return subject

    def _focal_px(
        self, landmarks_px: Float[np.ndarray, "F 478 2"], width: int, height: int
    ) -> float:
        return self.config.focal_px or usual_focal_px(
            float(np.median(face_height_px(landmarks_px))), width, height
        )

    def thetas(self, fit: ClipFit) -> Float[np.ndarray, "F H"]:
        """theta of every frame, upon the body where that is known."""
        return self._head_thetas(fit) if fit.upon_body is None else fit.upon_body

    def _head_thetas(self, fit: ClipFit) -> Float[np.ndarray, "F H"]:
        """theta as it was fitted: the head is the whole body."""
        return np.array([self.cost.theta(values) for values in fit.values])

    def fitted_px(self, fit: ClipFit, *, with_offsets: bool = True) -> Float[np.ndarray, "F L 2"]:
        """Where FaceMesh sees the fitted head's points, source pixels, with or without offsets.

        The offsets are the subject's own; the detector's response is in both.
        """
        head = self.cost.head if with_offsets else self._seen
        identity, camera = fit.subject.identity, fit.subject.camera
        return np.array(
            [
                camera.project(head.points(theta, identity, camera.eye_m))
                for theta in self._head_thetas(fit)
            ]
        )[:, : len(self.facemesh_index)]

    def face_distances_m(self, fit: ClipFit) -> Float[np.ndarray, "F"]:
        """How far the middle of the landmarks is from the camera, in each frame."""
        eye_m = fit.subject.camera.eye_m
        middles = [
            self._seen.points(theta, fit.subject.identity).mean(0)
            for theta in self._head_thetas(fit)
        ]
        return np.linalg.norm(np.array(middles) - eye_m, axis=1)

    def irises_px(self, fit: ClipFit) -> Float[np.ndarray, "F 2 2"]:
        """Where the middle of the mesh's right iris and of its left one is, source pixels."""
        irises = LandmarkHead(self.head, *iris_places(self.head.arrays))
        points = [irises.points(theta, fit.subject.identity) for theta in self.thetas(fit)]
        return fit.subject.camera.project(np.array(points))

    def gaze(self, fit: ClipFit) -> Float[np.ndarray, "F 4"]:
        """Pitch and yaw of the right eye and of the left one, radians."""
        first = [self.head.layout.slice(name).start for name in ("right_eye", "left_eye")]
        return self.thetas(fit)[:, [column + angle for column in first for angle in (0, 1)]]

    def rejected(self, fit: ClipFit, landmarks_px: Float[np.ndarray, "F 478 2"]) -> list[int]:
        """Positions whose landmarks no pose of the head explains."""
        poor = self._misfits(fit, landmarks_px) > _REJECT_SHARE
        return [int(position) for position in np.flatnonzero(poor)]

    def _misfits(
        self, fit: ClipFit, landmarks_px: Float[np.ndarray, "F 478 2"]
    ) -> Float[np.ndarray, "F"]:
        """How far the fitted head is from each frame's landmarks, in heights of the face."""
        away = self.fitted_px(fit) - landmarks_px[:, self.facemesh_index]
        return np.linalg.norm(away, axis=-1).mean(1) / face_height_px(landmarks_px)

    def vertices_px(self, fit: ClipFit, position: int) -> Float[np.ndarray, "V 2"]:
        """The full mesh of one frame in source pixels."""
        known = fit.upon_body
        row = self.cost.theta(fit.values[position]) if known is None else known[position]
        theta = torch.from_numpy(row)
        with torch.no_grad(), using_threads(1):  # Other threads are busy with faces and mattes.
            vertices = self.head(theta, self._person(fit.subject.identity))
        return fit.subject.camera.project(vertices.numpy())


class _AsTensor:
    """The same tensor for the same array, so that the head knows its person again.

    To fold an identity into the mesh takes as long as to pose it.
    """

    def __init__(self) -> None:
        self._known: tuple[np.ndarray, torch.Tensor] | None = None

    def __call__(self, array: Float[np.ndarray, "I"]) -> Float[torch.Tensor, "I"]:
        known = self._known
        if known is None or known[0] is not array:
            known = self._known = array, torch.from_numpy(array)
        return known[1]
