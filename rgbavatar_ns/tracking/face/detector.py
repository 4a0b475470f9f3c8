"""Face landmarks by mediapipe's FaceMesh with irises, followed from frame to frame."""

import importlib
import os
from types import ModuleType

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.face.follow import FaceFollower
from rgbavatar_ns.tracking.input.image_files import fitted_size

FOREHEAD, CHIN = 10, 152
IRIS_CENTERS = (468, 473)
"""FaceMesh's iris centres; 468 is the subject's right eye, 473 the left one."""
IRIS_RIMS = ((469, 470, 471, 472), (474, 475, 476, 477))
"""Four points around each of them."""
FACE_OVAL = (
    *(10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377),
    *(152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109),
)
"""Where FaceMesh puts the outline of the face as seen: these points slide over the skin."""
LIP_PAIRS = ((13, 14), (82, 87), (312, 317), (81, 178), (311, 402), (80, 88), (310, 318))
LID_PAIRS = ((159, 145), (158, 153), (160, 144), (386, 374), (385, 380), (387, 373))
"""Pairs of points whose distance says how far lips and lids are open."""
EYE_CORNERS = ((33, 133), (362, 263))
"""Corners of the subject's right and left eye; their distance is an eye's width."""
MAX_SIDE_PX = 1280
"""Images that are larger are made smaller before faces are looked for."""
_MOST_FACES = 3
# Where lids are less than the first share of the eye's width apart, FaceMesh guesses the iris: on
# renders it is off by 1 mm and more there, beyond the second share by .4 mm.
_IRIS_HIDDEN, _IRIS_SHOWN = 0.1, 0.2

INSTALL_MEDIAPIPE = (
    "pip install --no-deps mediapipe==0.10.21 protobuf==4.25.9 absl-py attrs flatbuffers"
)
"""Without the other packages that it names: a second OpenCV, and what the tracker does not ask of
it."""


def load_mediapipe() -> ModuleType:
    """mediapipe, imported on first use; UserError with the remedy where it is absent."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    remedy = f"Install it without its second OpenCV: {INSTALL_MEDIAPIPE}"
    try:
        mediapipe = importlib.import_module("mediapipe")
        protobuf = importlib.import_module("google.protobuf").__version__
    except ImportError as error:
        raise UserError(
            f"Tracking needs mediapipe, which cannot be imported ({error}).", remedy
        ) from error
    if int(protobuf.split(".")[0]) < 4:
        raise UserError(f"mediapipe's graphs fail beside protobuf {protobuf}.", remedy)
    return mediapipe


class FaceLandmarker:
    """FaceMesh over the frames of a video in order; order matters, it goes on from each frame.

    Called, it keeps to one face (`FaceFollower`); `faces` gives all it sees, up to `_MOST_FACES`.
    """

    def __init__(self) -> None:
        face_mesh = load_mediapipe().solutions.face_mesh
        self._mesh = face_mesh.FaceMesh(
            static_image_mode=False, max_num_faces=_MOST_FACES, refine_landmarks=True
        )
        self._follower = FaceFollower()

    def close(self) -> None:
        """Free mediapipe's graph."""
        self._mesh.close()

    def __call__(self, image_rgb: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "478 2"] | None:
        """The followed face's landmarks in pixels (first pixel's centre at .5, .5), or None."""
        height, width = image_rgb.shape[:2]
        faces = self.faces(image_rgb) * (width, height)
        followed = self._follower(faces, width, height).position
        return None if followed is None else faces[followed]

    def faces(self, image_rgb: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "N 478 2"]:
        """Every face's landmarks as shares of the image's width and height."""
        height, width = image_rgb.shape[:2]
        small = fitted_size(width, height, MAX_SIDE_PX)
        if small != (width, height):
            image_rgb = cv2.resize(image_rgb, small, interpolation=cv2.INTER_AREA)
        found = self._mesh.process(np.ascontiguousarray(image_rgb)).multi_face_landmarks or []
        faces = [[(point.x, point.y) for point in face.landmark] for face in found]
        return np.array(faces).reshape(-1, 478, 2)


def face_height_px(landmarks_px: Float[np.ndarray, "*batch 478 2"]) -> Float[np.ndarray, "*batch"]:
    """Distance from the top of the forehead to the chin, the measure of errors."""
    span = landmarks_px[..., FOREHEAD, :] - landmarks_px[..., CHIN, :]
    return np.linalg.norm(span, axis=-1)


def eye_widths_px(
    landmarks_px: Float[np.ndarray, "*batch 478 2"],
) -> Float[np.ndarray, "*batch 2"]:
    """Distance of the corners of the right eye and of the left one."""
    first, second = (landmarks_px[..., list(ends), :] for ends in zip(*EYE_CORNERS))
    return np.linalg.norm(first - second, axis=-1)


def irises_seen(landmarks_px: Float[np.ndarray, "*batch 478 2"]) -> Float[np.ndarray, "*batch 2"]:
    """How much the right iris and the left one are to be believed: 0 behind closed lids, else 1."""
    upper, lower = (landmarks_px[..., list(ends), :] for ends in zip(*LID_PAIRS))
    gap = np.linalg.norm(upper - lower, axis=-1)
    gap = gap.reshape(*gap.shape[:-1], 2, len(LID_PAIRS) // 2).mean(-1)
    share = gap / (eye_widths_px(landmarks_px) + 1e-9)
    return ((share - _IRIS_HIDDEN) / (_IRIS_SHOWN - _IRIS_HIDDEN)).clip(0, 1)


def upright_turn(
    landmarks_px: Float[np.ndarray, "*batch 478 2"],
) -> Float[np.ndarray, "*batch 2 2"]:
    """Rotation of the image after which the forehead is straight above the chin (-y)."""
    span = landmarks_px[..., FOREHEAD, :] - landmarks_px[..., CHIN, :]
    x, y = np.moveaxis(span / np.linalg.norm(span, axis=-1, keepdims=True), -1, 0)
    return np.stack([np.stack([-y, x], -1), np.stack([-x, -y], -1)], -2)
