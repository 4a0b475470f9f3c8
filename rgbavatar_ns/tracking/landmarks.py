"""Face landmarks by mediapipe's FaceMesh with irises, followed from frame to frame."""

import importlib
import os
from types import ModuleType, TracebackType

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rgbavatar_ns.errors import UserError

FOREHEAD, CHIN = 10, 152
IRIS_CENTERS = (468, 473)
"""FaceMesh's iris centres; 468 is the subject's right eye, 473 the left one."""
FACE_OVAL = (
    *(10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377),
    *(152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109),
)
"""Where FaceMesh puts the outline of the face as seen: these points slide over the skin."""
_MAX_SIDE_PX = 1280


def load_mediapipe() -> ModuleType:
    """mediapipe, imported on first use; UserError with the remedy where it is absent."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    try:
        return importlib.import_module("mediapipe")
    except ImportError as error:
        raise UserError(
            f"Tracking needs mediapipe, which cannot be imported ({error}).",
            "Install it without its second OpenCV: "
            "pip install --no-deps mediapipe==0.10.9 absl-py attrs flatbuffers",
        ) from error


class FaceLandmarker:
    """FaceMesh over the frames of a video in order; it follows one face, so order matters."""

    def __init__(self) -> None:
        face_mesh = load_mediapipe().solutions.face_mesh
        self._mesh = face_mesh.FaceMesh(
            static_image_mode=False, max_num_faces=1, refine_landmarks=True
        )

    def __enter__(self) -> "FaceLandmarker":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._mesh.close()

    def __call__(self, image_rgb: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "478 2"] | None:
        """Landmarks in pixels (centre of the first pixel at .5, .5), or None without a face."""
        height, width = image_rgb.shape[:2]
        shrink = _MAX_SIDE_PX / max(height, width)
        if shrink < 1:
            small = (max(1, round(width * shrink)), max(1, round(height * shrink)))
            image_rgb = cv2.resize(image_rgb, small, interpolation=cv2.INTER_AREA)
        found = self._mesh.process(np.ascontiguousarray(image_rgb)).multi_face_landmarks
        if not found:
            return None
        relative = np.array([[point.x, point.y] for point in found[0].landmark])
        return relative * (width, height)


def face_height_px(landmarks_px: Float[np.ndarray, "*batch 478 2"]) -> Float[np.ndarray, "*batch"]:
    """Distance from the top of the forehead to the chin, the measure of errors."""
    span = landmarks_px[..., FOREHEAD, :] - landmarks_px[..., CHIN, :]
    return np.linalg.norm(span, axis=-1)
