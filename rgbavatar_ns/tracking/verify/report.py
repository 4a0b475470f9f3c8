"""The numbers that tell whether a clip was tracked well, and what they mean in words."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from rgbavatar_ns.data.check.problems import Finding, Severity
from rgbavatar_ns.data.check.silhouette import silhouette_overlap
from rgbavatar_ns.tracking.face.detector import LID_PAIRS, LIP_PAIRS, face_height_px
from rgbavatar_ns.tracking.face.iris import FoundIrises
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.image.head_mask import HeadOutline
from rgbavatar_ns.tracking.verify.gaze import gaze_quality

# An eye is closed where its lids' gap is below this share of the clip's widely open ones.
_CLOSED_SHARE = 0.5
# Limits of the words: beyond the first a clip is no longer good, beyond the second it is to be
# looked at. Shares of the face's height, correlations, shares of frames, pixels,
# eye widths (on renders, whose truth is known, found irises lie .02 off).
_FITTED_ERROR, _MESH_ERROR = (0.01, 0.02), (0.015, 0.03)
_CORRELATION, _COVERAGE = (0.85, 0.6), (0.95, 0.85)
_IRIS_ERROR, _AT_BOUND = (0.1, 0.2), (0.02, 0.2)
_REJECTED, _BLURRED = (0.05, 0.25), (0.1, 0.3)
_FACE_PX, _FRAMES = (100.0, 50.0), (100, 25)
# How far the background wanders, in shares of the face's height, until the camera is said to move.
_MOVES = 0.03
# A body that is not there or hardly, square centimetres (shoulders and chest have 800, the two real
# clips, which end at the collar, 40), and shares of frames with something before or beside it.
_NO_BODY_CM2, _LITTLE_BODY_CM2 = 15.0, 80.0
_COVERED, _SOMEBODY = 0.03, 0.05
# The part of the face whose outline is skin: from a little above the chin to the eyes, as shares
# of the height from chin to forehead; and how far beside the head the matte is looked at.
_FACE_FROM, _FACE_TO, _BESIDE = 0.1, 0.6, 0.2
# A mesh that is too large stands out of the matte by a rim; what the matte lacks deeper within the
# mesh, as a share of the face's height, is the matte's own fault.
_RIM = 0.1
# Of the face's height: an opening that changes by less does not tell whether it is followed. A fit
# that follows differs from what is measured by .002 to .006 (standard deviations, real people).
_LEAST_OPENING = 0.02


def fit_quality(
    tracker: SubjectTracker,
    fit: ClipFit,
    bare_px: Float[np.ndarray, "F L 2"],
    landmarks_px: Float[np.ndarray, "F 478 2"],
    irises: FoundIrises,
) -> dict[str, Any]:
    """Reprojection errors, agreement of lips and lids, blinks, gaze, and the camera.

    Errors are mean distances over all landmarks and frames: `reprojection` with the subject's
    constant landmark offsets, which is what the fit minimises, and `mesh` without them. Shares
    are of the face's height (forehead to chin). `bare_px` are the tracker's fitted points without
    these offsets.
    """
    found = landmarks_px[:, tracker.facemesh_index]
    height = face_height_px(landmarks_px)
    fitted = tracker.fitted_px(fit)
    error = np.linalg.norm(fitted - found, axis=-1).mean(1)
    mesh_error = np.linalg.norm(bare_px - found, axis=-1).mean(1)
    gaps = {
        name: [
            gap_shares(points, tracker.facemesh_index, pairs, height) for points in (fitted, found)
        ]
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
        "blinks_measured": count_blinks(gaps["eyelid"][1]),
        "blinks_fitted": count_blinks(gaps["eyelid"][0]),
        **gaze_quality(tracker, fit, landmarks_px, irises),
        "focal_px": fit.subject.camera.focal_px,
        "camera_distance_m": float(np.median(tracker.face_distances_m(fit))),
    }


def gap_shares(
    points_px: Float[np.ndarray, "F L 2"],
    facemesh_index: Int[np.ndarray, "L"],
    pairs: Sequence[tuple[int, int]],
    height_px: Float[np.ndarray, "F"],
) -> Float[np.ndarray, "F"]:
    """How far lips or lids are open in each frame: the mean distance of these pairs, as a share of
    the face's height, so that a face that comes nearer opens nothing."""
    place = {int(index): row for row, index in enumerate(facemesh_index)}
    rows = np.array([(place[a], place[b]) for a, b in pairs])
    gaps_px = np.linalg.norm(points_px[:, rows[:, 0]] - points_px[:, rows[:, 1]], axis=-1)
    return gaps_px.mean(1) / height_px


def gap_correlation(fitted: Float[np.ndarray, "F"], found: Float[np.ndarray, "F"]) -> float | None:
    """How well the fitted opening, a share of the face's height, follows the measured one.

    None where the one never changes, or the other by no more than landmarks and mesh disagree.
    """
    if float(fitted.std()) < 1e-9 or np.ptp(found) < _LEAST_OPENING:
        return None
    return float(np.corrcoef(fitted, found)[0, 1])


def closed_eyes(gap: Float[np.ndarray, "F"]) -> Bool[np.ndarray, "F"]:
    """Frames whose lids are less than half as far apart as in the clip's open-eyed frames."""
    return gap < _CLOSED_SHARE * np.percentile(gap, 90)


def count_blinks(gap: Float[np.ndarray, "F"]) -> int:
    """How often the eyes close."""
    closed = closed_eyes(gap)
    return int(closed[0]) + int(np.count_nonzero(closed[1:] & ~closed[:-1]))


def silhouette_shares(
    outline: HeadOutline, matte: Float[np.ndarray, "s s"], inside: Float[np.ndarray, "s s"]
) -> dict[str, float | None]:
    """How well mesh and matte of a frame agree; None where the head is outside of the image.

    `coverage`: the share of the mesh above the chin that the matte holds; the rest is `outside`,
    the share by which a rim of the mesh stands out of the matte, and `missed`, what the matte
    lacks deeper within the mesh: holes and parts of the head. `face_iou`: intersection
    over union of both between chin and eyes, up to a fifth of the face's height beside the mesh:
    there the outline is skin, unless hair hangs down beside the cheeks, which lowers it. `inside`
    is 1 where the image is.
    """
    seen, height = inside > 0.5, outline.above_chin
    head = silhouette_overlap(outline.silhouette, matte, seen & (height > 0))
    core = _core(outline.silhouette, round(_RIM * outline.face_height_px))
    missing = (outline.silhouette > 0.5) & (matte <= 0.5) & seen & (height > 0)
    missed, lacking = int((missing & core).sum()), int(missing.sum())
    skin = seen & (height > _FACE_FROM) & (height < _FACE_TO)
    columns = np.flatnonzero(((outline.silhouette > 0.5) & skin).any(0))
    if columns.size:
        beside = round(_BESIDE * outline.face_height_px)
        skin[:, : max(0, columns[0] - beside)] = False
        skin[:, columns[-1] + 1 + beside :] = False
    face = silhouette_overlap(outline.silhouette, matte, skin)
    return {
        "coverage": head.covered if head.mesh else None,
        "outside": (lacking - missed) / head.mesh if head.mesh else None,
        "missed": missed / head.mesh if head.mesh else None,
        "face_iou": face.iou if face.either else None,
    }


def _core(silhouette: Float[np.ndarray, "s s"], rim_px: int) -> Bool[np.ndarray, "s s"]:
    """The mesh without a rim of so many pixels; beyond the image it goes on."""
    mesh = np.pad((silhouette > 0.5).astype(np.uint8), 1, mode="edge")
    within = cv2.distanceTransform(mesh, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
    return np.asarray(within > rim_px)


def silhouette_summary(shares: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Means over all frames' `silhouette_shares`, and the lowest coverage."""
    known = {
        name: [share for one in shares if (share := one[name]) is not None]
        for name in ("coverage", "outside", "missed", "face_iou")
    }
    means = {name: float(np.mean(found)) if found else None for name, found in known.items()}
    return {
        "silhouette_coverage": means["coverage"],
        "worst_silhouette_coverage": min(known["coverage"], default=None),
        "mesh_outside_matte": means["outside"],
        "matte_misses": means["missed"],
        "face_silhouette_iou": means["face_iou"],
    }


def tracking_findings(report: Mapping[str, Any]) -> list[Finding]:
    """What is amiss in a clip's figures: beyond a limit to be looked at, or to be known."""
    tracked, read, blurred = report["frames_tracked"], report["frames_read"], report["blurred"]
    height = report["face_height_px"]
    fitted, mesh = (report[f"{one}reprojection_error_share"] for one in ("", "mesh_"))
    mouth, lids = (report[f"{one}_opening_correlation"] for one in ("mouth", "eyelid"))
    at_bound = report["gaze_at_bound_share"]
    found = []
    outside, missed = report["mesh_outside_matte"], report["matte_misses"]
    # Whichever lacks more: the mesh stands out of the matte, or the matte misses what is there.
    by_mesh = outside is not None and outside > missed
    culprit: tuple[str, str] = (
        ("misfit", "the mesh stands out of the person's outline")
        if by_mesh
        else ("mattes", "the matte misses part of the head")
    )
    for kind, cause, value, (mild, grave) in (
        ("landmarks", "the fit leaves the landmarks", fitted, _FITTED_ERROR),
        ("misfit", "the mesh lies off the face", mesh, _MESH_ERROR),
        ("landmarks", "the mouth is not followed", mouth, _CORRELATION),
        ("landmarks", "the eyelids are not followed", lids, _CORRELATION),
        ("gaze", "the irises lie off the film's", report["iris_error_eye_widths"], _IRIS_ERROR),
        ("gaze", f"the gaze is at its bounds in {at_bound:.0%} of frames", at_bound, _AT_BOUND),
        (*culprit, report["silhouette_coverage"], _COVERAGE),
        ("faces", f"{read - tracked} of {read} frames are left out", 1 - tracked / read, _REJECTED),
        ("faces", f"{len(blurred)} frames are blurred", len(blurred) / tracked, _BLURRED),
        ("faces", f"the face is only {height:.0f} pixels high", height, _FACE_PX),
        ("faces", f"there are only {tracked} frames", tracked, _FRAMES),
    ):
        sign = 1 if grave > mild else -1
        if value is not None and sign * (value - mild) > 0:
            severity: Severity = "error" if sign * (value - grave) > 0 else "warning"
            found.append(Finding(kind, severity, cause))
    found += _background_findings(report)
    found += _body_findings(report["body"] or {})
    others = len(report["other_faces"])
    if others:
        found.append(Finding("faces", "error", f"another face is seen in {others} frames"))
    return found


def _background_findings(report: Mapping[str, Any]) -> list[Finding]:
    """What moves behind the person: all of it with the camera, or somebody, something."""
    body = report["body"] or {}
    moved_px = body.get("background_moves_px")
    if moved_px is not None and moved_px > _MOVES * report["face_height_px"]:
        return [Finding("camera", "warning", "the camera moves")]
    if report.get("background") != "moves":
        return []
    # What the body's follower finds still in either half of the whole picture, no camera moves.
    still = body.get("background_stands", False)
    cause = "something moves behind the person" if still else "the camera moves"
    if still and len({part["clip"] for part in report["segments"]}) > 1:
        cause = "the clips show other rooms, or from another place, or something moves in them"
    return [Finding("camera", "warning", cause)]


def _body_findings(body: Mapping[str, Any]) -> list[Finding]:
    """What keeps the body from being followed: of a body that is not seen, nothing else is told."""
    seen, covered, beside = (
        body.get(name) for name in ("seen_cm2", "covered_share", "beside_share")
    )
    if seen is not None and seen < _LITTLE_BODY_CM2:
        nothing = "no body is in the picture: it is taken to keep still"
        cause = nothing if seen < _NO_BODY_CM2 else "the body is hardly seen"
        return [Finding("body", "warning", cause)]
    found = []
    if covered is not None and covered > _COVERED:
        cause = f"something is before the body in {covered:.0%} of frames (an arm, a hand)"
        found.append(Finding("body", "warning", cause))
    if beside is not None and beside > _SOMEBODY:
        cause = f"beside the person there is somebody, or a chair, in {beside:.0%} of frames"
        found.append(Finding("body", "warning", cause))
    return found
