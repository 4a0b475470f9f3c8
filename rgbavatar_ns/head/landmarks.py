"""Where mediapipe's FaceMesh points lie on the embedded head."""

from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

LANDMARK_FILE = Path(__file__).parent / "assets" / "facemesh_landmarks.npz"
RESPONSE_FILE = LANDMARK_FILE.with_name("facemesh_response.npz")

UNSURE_M = 0.002
"""Where a place on the mesh is unsure by sqrt(3) of this, a point errs twice as much by itself."""

SPARSE_51 = (
    *(70, 63, 105, 66, 107, 336, 296, 334, 293, 300),
    *(168, 197, 195, 4, 98, 97, 2, 326, 327),
    *(33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380),
    *(61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181),
    *(78, 82, 13, 312, 308, 317, 14, 87),
)
"""FaceMesh indices of the usual 68 points without the jaw line: brows, nose, eyes, mouth."""


_Kind = TypeVar("_Kind", bound="_Rows")


@dataclass(frozen=True)
class _Rows:
    """Arrays with a row for each landmark."""

    def select(self: _Kind, rows: Int[np.ndarray, "K"]) -> _Kind:
        """The same of these rows."""
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))

    def and_none(self: _Kind, count: int) -> _Kind:
        """The same with so many rows of zeros after them."""
        arrays = [getattr(self, field.name) for field in fields(self)]
        return type(self)(*(np.pad(a, [(0, count)] + [(0, 0)] * (a.ndim - 1)) for a in arrays))


@dataclass(frozen=True)
class LandmarkResponse(_Rows):
    """Where a detector puts L points apart from the skin they lie on, in the skull's frame, metres.

    Detectors follow faces incompletely: they round off expressions, and points of the outline
    slide over the skin as the head turns. Offsets are `rest`, plus the others times: the direction
    from the skull to the camera (x, y, x^2, y^2, xy), expression coefficients, the sine of the
    jaw's first angle, the sines of the eyes' pitch and yaw (their mean), identity coefficients.

    Ours: the usual way is to trust the points. FaceMesh's on the embedded head is made by
    scripts/build_landmark_response.py, from renders whose truth is known.
    """

    rest: Float[np.ndarray, "L 3"]
    view: Float[np.ndarray, "L 3 5"]
    expression: Float[np.ndarray, "L 3 E"]
    jaw_open: Float[np.ndarray, "L 3"]
    gaze: Float[np.ndarray, "L 3 2"]
    identity: Float[np.ndarray, "L 3 I"]


@dataclass(frozen=True)
class LandmarkNoise(_Rows):
    """How a detector's points err together: what remains when their response is known.

    A landmark's error in an upright face, as a share of the face's height, is taken for the sum of
    `modes`, each times a standard normal number that all landmarks share, and of an error of its
    own with the standard deviation `own_share` along each image axis.

    Ours: the usual way is to take each point's error for its own; but neighbours err together, so
    that many wrong points would outvote what a few right ones tell. Rows are FaceMesh indices.
    Made with the response; probabilistic principal components (Tipping and Bishop 1999).
    """

    modes: Float[np.ndarray, "L 2 K"]
    own_share: Float[np.ndarray, "L"]


@dataclass(frozen=True)
class LandmarkMap(_Rows):
    """L FaceMesh points as places on triangles of the embedded head, by FaceMesh index.

    Made by scripts/build_landmark_map.py, which looks at renders of the head with FaceMesh.
    """

    facemesh_index: Int[np.ndarray, "L"]
    triangle: Int[np.ndarray, "L"]
    barycentric: Float[np.ndarray, "L 3"]
    mirror: Int[np.ndarray, "L"]
    """FaceMesh index of the point on the other side of the face; a middle point is its own."""
    spread_m: Float[np.ndarray, "L"]
    """How far single renders put the point from this place (median, metres): small is sure."""


@cache
def facemesh_landmarks() -> LandmarkMap:
    """All FaceMesh points that have a place on the embedded head, irises (468-477) included."""
    with np.load(LANDMARK_FILE, allow_pickle=False) as file:
        arrays = [file[field.name] for field in fields(LandmarkMap)]
    return LandmarkMap(
        *(one.astype(np.int64 if one.dtype.kind in "iu" else np.float64) for one in arrays)
    )


@cache
def facemesh_response() -> LandmarkResponse:
    """How FaceMesh's points follow the embedded head; rows as in `facemesh_landmarks`."""
    with np.load(RESPONSE_FILE, allow_pickle=False) as file:
        return LandmarkResponse(
            *(file[field.name].astype(np.float64) for field in fields(LandmarkResponse))
        )


@cache
def facemesh_noise() -> LandmarkNoise:
    """How FaceMesh's points err beside their response; rows are FaceMesh indices."""
    with np.load(RESPONSE_FILE, allow_pickle=False) as file:
        return LandmarkNoise(
            file["noise_modes"].astype(np.float64), file["noise_own_share"].astype(np.float64)
        )
