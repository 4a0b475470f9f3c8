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
    fit_outlines,
    fit_subject,
    key_frame_positions,
    subject_offsets,
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
        outlines: Sequence[PersonOutline | None] = (),
        irises: FoundIrises | None = None,
    ) -> ClipFit:
        """Identity, camera and offsets from key frames, then every frame.

        `outlines` are those of the person in the frames of `key_positions`, in their order;
        `irises` those found in the pictures, in pixels.
        """
        # The matrices are small: more threads would only wait for each other.
        with threadpool_limits(1):
            subject = self.fit_subject(landmarks_px, width, height, outlines, irises)
            targets = self.targets(landmarks_px, irises)
            weight = self.config.temporal_weight
            return fit_clip(self.cost, subject, targets, follows, weight, advance)

    def key_positions(self, landmarks_px: Float[np.ndarray, "F 478 2"]) -> list[int]:
        """The frames that the subject is fitted on: those that differ most."""
        return key_frame_positions(landmarks_px, self.config.key_frames)

    def fit_subject(
        self,
        landmarks_px: Float[np.ndarray, "F 478 2"],
        width: int,
        height: int,
        outlines: Sequence[PersonOutline | None] = (),
        irises: FoundIrises | None = None,
    ) -> SubjectFit:
        """Identity, camera and landmark offsets from the key frames.

        `outlines` and `irises` as in `fit`; without any, landmarks alone decide.
        """
        positions = self.key_positions(landmarks_px)
        key_irises = None if irises is None else irises.of(positions)
        keys = self.targets(landmarks_px[positions], key_irises)
        shared = min(self.config.identity_components, self.cost.head.num_identity)
        subject = fit_subject(self.cost, keys, width, height, shared, self.config.focal_px)
        if outlines:
            outline_cost = OutlineCost(self.head, self.cost.parameters.columns, shared)
            subject = fit_outlines(self.cost, outline_cost, keys, outlines, subject, shared)
        offsets = subject_offsets(self.cost, subject, keys)
        # An iris that is seen is where the mesh's is to be.
        offsets[len(self.facemesh_index) :] = 0
        self.cost = replace(self.cost, head=self.cost.head.with_offsets(offsets))
        return subject

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
        away = self.fitted_px(fit) - landmarks_px[:, self.facemesh_index]
        share = np.linalg.norm(away, axis=-1).mean(1) / face_height_px(landmarks_px)
        return [int(position) for position in np.flatnonzero(share > _REJECT_SHARE)]

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
