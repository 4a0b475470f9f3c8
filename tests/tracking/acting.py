"""A performance whose truth is known, what FaceMesh would see of it, and errors in degrees."""

import numpy as np
from scipy.spatial.transform import Rotation

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.subject import SubjectTracker

CAMERA = StillCamera(700.0, (160.0, 120.0), 0.8)
ACTIVE = ("mouthSmileLeft", "mouthPucker", "browInnerUp", "eyeBlinkLeft", "eyeBlinkRight")


def performance(head: HeadModel, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Smooth theta [F, H] with turns, jaw, gaze, blinks and expressions, and an identity."""
    random = np.random.default_rng(11)
    layout, names = head.layout, list(head.arrays.expression_names)
    theta = np.zeros((frames, layout.size))
    time = np.linspace(0, 2 * np.pi, frames)
    turns = [0.12 * np.sin(time), 0.25 * np.sin(2 * time + 1), 0.08 * np.cos(time)]
    theta[:, layout.slice("rotation")] = np.stack(turns, axis=1)
    theta[:, layout.slice("translation")] = 0.015 * np.stack(
        [np.sin(time + k) for k in range(3)], 1
    )
    theta[:, layout.slice("jaw").start] = 0.12 * (1 - np.cos(2 * time))
    for eye in ("left_eye", "right_eye"):
        theta[:, layout.slice(eye).start + 1] = 0.2 * np.sin(time + 2)
    for number, name in enumerate(ACTIVE):
        wave = 0.5 + 0.5 * np.sin((1 + number % 3) * time + number)
        theta[:, layout.slice("expression").start + names.index(name)] = 0.8 * wave
    identity = np.zeros(head.num_identity)
    identity[:10] = 0.5 * random.normal(size=10)
    return theta, identity


def observed(tracker: SubjectTracker, theta: np.ndarray, identity: np.ndarray) -> np.ndarray:
    points = np.zeros((len(theta), 478, 2))
    for frame, row in enumerate(theta):
        projected = CAMERA.project(tracker.cost.head.points(row, identity, CAMERA.eye_m))
        points[frame, tracker.facemesh_index] = projected[: len(tracker.facemesh_index)]
    return points


def acted(
    head: HeadModel, frames: int, **options: float
) -> tuple[SubjectTracker, np.ndarray, np.ndarray, np.ndarray]:
    """A tracker of known focal length; theta, identity and landmarks of a performance."""
    tracker = SubjectTracker(head, TrackConfig(focal_px=CAMERA.focal_px, **options))
    theta, identity = performance(head, frames)
    return tracker, theta, identity, observed(tracker, theta, identity)


def degrees_apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Between rotation matrices [..., 3, 3], one by one."""
    apart = first @ np.swapaxes(second, -1, -2)
    return np.degrees(Rotation.from_matrix(apart.reshape(-1, 3, 3)).magnitude())


def skulls(tracker: SubjectTracker, thetas: np.ndarray) -> np.ndarray:
    """World rotations [F, 3, 3] of the skull."""
    return np.array([tracker.mesh_landmarks.head_rotation(theta) for theta in thetas])
