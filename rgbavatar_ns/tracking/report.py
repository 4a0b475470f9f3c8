"""The numbers that tell whether a clip was tracked well."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.tracking.fit import ClipFit
from rgbavatar_ns.tracking.frame_cost import LID_PAIRS, LIP_PAIRS
from rgbavatar_ns.tracking.landmarks import face_height_px
from rgbavatar_ns.tracking.subject import SubjectTracker


def fit_quality(
    tracker: SubjectTracker, fit: ClipFit, landmarks_px: Float[np.ndarray, "F 478 2"]
) -> dict[str, Any]:
    """Reprojection errors, agreement of lips and lids, and the camera.

    Errors are mean distances over all landmarks and frames: `reprojection` with the subject's
    constant landmark offsets, which is what the fit minimises, and `mesh` without them. Shares
    are of the face's height (forehead to chin).
    """
    found = landmarks_px[:, tracker.facemesh_index]
    height = face_height_px(landmarks_px)
    fitted = tracker.fitted_px(fit)
    bare = tracker.fitted_px(fit, with_offsets=False)
    error = np.linalg.norm(fitted - found, axis=-1).mean(1)
    mesh_error = np.linalg.norm(bare - found, axis=-1).mean(1)
    return {
        "reprojection_error_px": float(error.mean()),
        "reprojection_error_share": float((error / height).mean()),
        "worst_frame_error_share": float((error / height).max()),
        "mesh_reprojection_error_px": float(mesh_error.mean()),
        "mesh_reprojection_error_share": float((mesh_error / height).mean()),
        "face_height_px": float(height.mean()),
        "mouth_opening_correlation": gap_correlation(
            fitted, found, tracker.facemesh_index, LIP_PAIRS
        ),
        "eyelid_opening_correlation": gap_correlation(
            fitted, found, tracker.facemesh_index, LID_PAIRS
        ),
        "focal_px": fit.subject.camera.focal_px,
        "camera_distance_m": fit.subject.camera.distance_m,
    }


def gap_correlation(
    fitted_px: Float[np.ndarray, "F L 2"],
    found_px: Float[np.ndarray, "F L 2"],
    facemesh_index: Int[np.ndarray, "L"],
    pairs: Sequence[tuple[int, int]],
) -> float | None:
    """How well the fitted opening of lips or lids follows the measured one over the clip.

    None where an opening never changes.
    """
    place = {int(index): row for row, index in enumerate(facemesh_index)}
    rows = np.array([(place[a], place[b]) for a, b in pairs])
    openings = [
        np.linalg.norm(points[:, rows[:, 0]] - points[:, rows[:, 1]], axis=-1).mean(1)
        for points in (fitted_px, found_px)
    ]
    if min(float(opening.std()) for opening in openings) < 1e-9:
        return None
    return float(np.corrcoef(openings[0], openings[1])[0, 1])


def write_report(path: Path, report: dict[str, Any]) -> None:
    """`tracking.json`, readable by people."""
    path.write_text(json.dumps(report, indent=2) + "\n")
