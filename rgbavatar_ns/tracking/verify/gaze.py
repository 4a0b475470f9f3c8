"""Whether the fitted head looks where the film's person does."""

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.tracking.face.detector import eye_widths_px, irises_seen
from rgbavatar_ns.tracking.face.iris import FoundIrises
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.parameters import GAZE_BOUNDS_RAD
from rgbavatar_ns.tracking.fit.subject import SubjectTracker

# An eye within half a degree of what the fit allows would go on if it might.
_AT_BOUND_RAD = 0.01
_OPEN = 0.5


def gaze_quality(
    tracker: SubjectTracker,
    fit: ClipFit,
    landmarks_px: Float[np.ndarray, "F 478 2"],
    irises: FoundIrises,
) -> dict[str, float | None]:
    """How far the mesh's irises lie from the found ones, and how often the gaze is at its bounds.

    Distances are of the middles of irises, in widths of their eye (corner to corner): mean and
    95th percentile over eyes and frames; None where no iris is ever found. `irises_found_share` is
    the share of open eyes in which one is; `gaze_at_bound_share` is the share of frames with either
    eye at a bound of the fit.
    """
    away = iris_distances(tracker.irises_px(fit), landmarks_px, irises)
    away = away[np.isfinite(away)]
    open_eyes = irises_seen(landmarks_px) > _OPEN
    at_bound = np.abs(tracker.gaze(fit)) > GAZE_BOUNDS_RAD[1] - _AT_BOUND_RAD
    return {
        "iris_error_eye_widths": float(away.mean()) if away.size else None,
        "worst_iris_error_eye_widths": float(np.percentile(away, 95)) if away.size else None,
        "irises_found_share": float((irises.found & open_eyes).sum() / max(open_eyes.sum(), 1)),
        "gaze_at_bound_share": float(at_bound.any(1).mean()),
    }


def iris_distances(
    irises_px: Float[np.ndarray, "F 2 2"],
    landmarks_px: Float[np.ndarray, "F 478 2"],
    irises: FoundIrises,
) -> Float[np.ndarray, "F 2"]:
    """From the found iris of the right eye and of the left one, eye widths; NaN where none is."""
    away_px = np.linalg.norm(irises_px - irises.centers, axis=-1)
    return np.where(irises.found, away_px / eye_widths_px(landmarks_px).clip(1e-9), np.nan)
