"""The contact sheet of a tracked clip: frames most likely to be wrong, and some of the rest."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from rgbavatar_ns.data.check.contact_sheet import write_contact_sheet
from rgbavatar_ns.data.native.format import image_path
from rgbavatar_ns.data.png import read_png_rgba
from rgbavatar_ns.drawing.contact_sheet import labelled, over_gray_bgr
from rgbavatar_ns.drawing.wireframe import fixed_point, with_wireframe
from rgbavatar_ns.tracking.face.clip import ClipLandmarks
from rgbavatar_ns.tracking.face.detector import LID_PAIRS, LIP_PAIRS, face_height_px
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.image.crop import SquareCrop
from rgbavatar_ns.tracking.verify.report import gap_shares

_TILES, _TILE_PX = 12, 384
_FOUND_BGR, _FITTED_BGR = (80, 255, 80), (60, 60, 255)
# FaceMesh points at the face's sides and the tip of the nose: they tell how far it is turned.
_SIDES, _NOSE_TIP = (234, 454), 4


def write_tracking_sheet(
    dst: Path,
    tracker: SubjectTracker,
    fit: ClipFit,
    bare_px: Float[np.ndarray, "F L 2"],
    found: ClipLandmarks,
    crop: SquareCrop,
) -> None:
    """`overlay.png` in the dataset `dst`, whose images are there.

    `bare_px` are the tracker's fitted points without the subject's offsets.
    """
    found_px = found.points_px[:, tracker.facemesh_index]
    error = np.linalg.norm(bare_px - found_px, axis=-1).mean(1)
    tiles = []
    for position, why in sheet_frames(found.points_px, error).items():
        index = found.frame_index[position]
        tiles.append(
            draw_tile(
                f"{index} {why}".strip(),
                read_png_rgba(image_path(dst, index)),
                crop.points(tracker.vertices_px(fit, position)),
                tracker.head.arrays.faces,
                crop.points(found_px[position]),
                crop.points(bare_px[position]),
            )
        )
    write_contact_sheet(dst / "overlay.png", tiles)


def draw_tile(
    label: str,
    image_rgba: UInt8[np.ndarray, "S S 4"],
    vertices_px: Float[np.ndarray, "V 2"],
    faces: Int[np.ndarray, "T 3"],
    found_px: Float[np.ndarray, "L 2"],
    fitted_px: Float[np.ndarray, "L 2"],
) -> UInt8[np.ndarray, "h w 3"]:
    """The matted image, and beside it the same with the mesh (blue), found (green) and fitted
    (red) landmarks; blue first."""
    zoom = _TILE_PX / image_rgba.shape[0]
    image = over_gray_bgr(image_rgba, zoom)
    drawn = with_wireframe(image, vertices_px * zoom, faces)
    for points, bgr in ((found_px, _FOUND_BGR), (fitted_px, _FITTED_BGR)):
        for x, y in fixed_point(points * zoom).tolist():
            cv2.circle(drawn, (x, y), 20, bgr, -1, cv2.LINE_AA, shift=4)
    return np.hstack([image, labelled(drawn, label)])


def sheet_frames(
    points_px: Float[np.ndarray, "F 478 2"], error_px: Float[np.ndarray, "F"]
) -> dict[int, str]:
    """Positions in order, with what each one is shown for ("" for those in between).

    The worst fit, the widest mouth, the most closed eyes, the furthest turns to both sides, then
    frames evenly over the clip.
    """
    height = face_height_px(points_px)
    every = np.arange(points_px.shape[1])
    nose, left, right = (points_px[:, k, 0] for k in (_NOSE_TIP, *_SIDES))
    turn = (nose - left) / (right - left + 1e-9)
    notable = {
        "worst fit": int(np.argmax(error_px / height)),
        "widest mouth": int(np.argmax(gap_shares(points_px, every, LIP_PAIRS, height))),
        "eyes most closed": int(np.argmin(gap_shares(points_px, every, LID_PAIRS, height))),
        "turned left": int(np.argmax(turn)),
        "turned right": int(np.argmin(turn)),
    }
    reasons: dict[int, list[str]] = {}
    for why, position in notable.items():
        reasons.setdefault(position, []).append(why)
    shown = min(_TILES, len(points_px))
    spread = np.linspace(0, len(points_px) - 1, shown).round().astype(int).tolist()
    for position in sorted(spread, key=lambda k: -min(abs(k - other) for other in reasons)):
        if len(reasons) < shown:
            reasons.setdefault(position, [])
    return {position: ", ".join(reasons[position]) for position in sorted(reasons)}
