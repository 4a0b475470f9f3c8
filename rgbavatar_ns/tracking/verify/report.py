"""The numbers that tell whether a clip was tracked well, and what they mean in words."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from rgbavatar_ns.tracking.face.detector import LID_PAIRS, LIP_PAIRS, face_height_px
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.subject import SubjectTracker

# An eye is closed where its lids' gap is below this share of the clip's widely open ones.
_CLOSED_SHARE = 0.5
# Limits of the words: beyond the first a clip is no longer good, beyond the second it is to be
# looked at. Shares of the face's height, correlations, shares of frames, pixels.
_FITTED_ERROR, _MESH_ERROR = (0.01, 0.02), (0.015, 0.03)
_CORRELATION, _COVERAGE = (0.85, 0.6), (0.95, 0.85)
_REJECTED, _BLURRED = (0.05, 0.25), (0.1, 0.3)
_FACE_PX, _FRAMES = (100.0, 50.0), (100, 25)


def fit_quality(
    tracker: SubjectTracker, fit: ClipFit, landmarks_px: Float[np.ndarray, "F 478 2"]
) -> dict[str, Any]:
    """Reprojection errors, agreement of lips and lids, blinks, and the camera.

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
    gaps = {
        name: [mean_gap(points, tracker.facemesh_index, pairs) for points in (fitted, found)]
        for name, pairs in (("mouth", LIP_PAIRS), ("eyelid", LID_PAIRS))
    }
    return {
        "reprojection_error_px": float(error.mean()),
        "reprojection_error_share": float((error / height).mean()),
        "worst_frame_error_share": float((error / height).max()),
        "mesh_reprojection_error_px": float(mesh_error.mean()),
        "mesh_reprojection_error_share": float((mesh_error / height).mean()),
        "face_height_px": float(height.mean()),
        "mouth_opening_correlation": gap_correlation(*gaps["mouth"]),
        "eyelid_opening_correlation": gap_correlation(*gaps["eyelid"]),
        "blinks_measured": count_blinks(gaps["eyelid"][1] / height),
        "blinks_fitted": count_blinks(gaps["eyelid"][0] / height),
        "focal_px": fit.subject.camera.focal_px,
        "camera_distance_m": fit.subject.camera.distance_m,
    }


def mean_gap(
    points_px: Float[np.ndarray, "F L 2"],
    facemesh_index: Int[np.ndarray, "L"],
    pairs: Sequence[tuple[int, int]],
) -> Float[np.ndarray, "F"]:
    """How far lips or lids are open in each frame: the mean distance of these pairs, pixels."""
    place = {int(index): row for row, index in enumerate(facemesh_index)}
    rows = np.array([(place[a], place[b]) for a, b in pairs])
    return np.linalg.norm(points_px[:, rows[:, 0]] - points_px[:, rows[:, 1]], axis=-1).mean(1)


def gap_correlation(fitted: Float[np.ndarray, "F"], found: Float[np.ndarray, "F"]) -> float | None:
    """How well the fitted opening follows the measured one; None where one never changes."""
    if min(float(fitted.std()), float(found.std())) < 1e-9:
        return None
    return float(np.corrcoef(fitted, found)[0, 1])


def closed_eyes(gap: Float[np.ndarray, "F"]) -> Bool[np.ndarray, "F"]:
    """Frames whose lids are less than half as far apart as in the clip's open-eyed frames."""
    return gap < _CLOSED_SHARE * np.percentile(gap, 90)


def count_blinks(gap: Float[np.ndarray, "F"]) -> int:
    """How often the eyes close."""
    closed = closed_eyes(gap)
    return int(closed[0]) + int(np.count_nonzero(closed[1:] & ~closed[:-1]))


def silhouette_summary(noted: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Means over all frames' `SilhouetteAgreement`, and the lowest coverage."""
    coverage = [one["coverage"] for one in noted if one["coverage"] is not None]
    face_iou = [one["face_iou"] for one in noted if one["face_iou"] is not None]
    return {
        "silhouette_coverage": float(np.mean(coverage)) if coverage else None,
        "worst_silhouette_coverage": float(np.min(coverage)) if coverage else None,
        "face_silhouette_iou": float(np.mean(face_iou)) if face_iou else None,
    }


def verdict(report: Mapping[str, Any]) -> str:
    """The report in words: "good", "usable: ..." or "look at it: ..." with what is amiss."""
    tracked, read = report["frames_tracked"], report["frames_read"]
    checks = [
        ("the fit leaves the landmarks", report["reprojection_error_share"], _FITTED_ERROR, 1),
        ("the mesh lies off the face", report["mesh_reprojection_error_share"], _MESH_ERROR, 1),
        ("the mouth is not followed", report["mouth_opening_correlation"], _CORRELATION, -1),
        ("the eyelids are not followed", report["eyelid_opening_correlation"], _CORRELATION, -1),
        ("the matte misses part of the head", report["silhouette_coverage"], _COVERAGE, -1),
        (f"{read - tracked} of {read} frames are left out", 1 - tracked / read, _REJECTED, 1),
        (
            f"{len(report['blurred'])} frames are blurred",
            len(report["blurred"]) / tracked,
            _BLURRED,
            1,
        ),
        (
            f"the face is only {report['face_height_px']:.0f} pixels high",
            report["face_height_px"],
            _FACE_PX,
            -1,
        ),
        (f"there are only {tracked} frames", tracked, _FRAMES, -1),
    ]
    mild, grave = [], []
    for words, value, (first, second), sign in checks:
        if value is None or sign * (value - first) <= 0:
            continue
        (grave if sign * (value - second) > 0 else mild).append(words)
    if report["other_faces"]:
        grave.append(f"another face is seen in {len(report['other_faces'])} frames")
    if grave:
        return f"look at it: {'; '.join(grave + mild)}"
    return f"usable: {'; '.join(mild)}" if mild else "good"


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """`tracking.json`, readable by people."""
    path.write_text(json.dumps(report, indent=2) + "\n")
