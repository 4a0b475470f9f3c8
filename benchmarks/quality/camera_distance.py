"""From how far away FaceMesh's points look: what a fit by focal lengths of many sizes leaves.

    python benchmarks/quality/camera_distance.py --seeds 8 9 10 11 --films me.mp4

Finds the landmarks of procedural people, whose camera is 1.1 m away, and of films; fits the person
to their key frames with focal lengths of so many heights of the face, and prints for each how far
the head comes to stand from the camera (m) and how far the mesh's points, without the person's own
offsets, stay from the landmarks (root mean square, percent of the face's height). The least is
last.
"""

import argparse
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from skull import STYLES
from subject import write_figures
from tracker import Subject

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.detector import FaceLandmarker, face_height_px
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.input.video import FrameSource

FOCAL_BY_FACE = (3.2, 4.2, 5.0, 5.8, 6.6, 7.6, 8.9, 10.5, 13.7)

_Landmarks = Float[np.ndarray, "F 478 2"]


def film_landmarks(film: Path) -> tuple[_Landmarks, int, int]:
    """Of all frames with a face, and the frames' width and height."""
    found, width, height = [], 0, 0
    with closing(FaceLandmarker()) as landmarker:
        for frame in FrameSource.open(film, None):
            points = landmarker(frame.image_rgb)
            width, height = frame.width, frame.height
            if points is not None:
                found.append(points)
    return np.array(found), width, height


def fitted(
    head: HeadModel,
    landmarks_px: _Landmarks,
    keys: Sequence[int],
    size: tuple[int, int],
    by_face: float,
) -> dict[str, float]:
    """The head's distance and the misfit with a focal length of so many heights of the face."""
    focal_px = by_face * float(np.median(face_height_px(landmarks_px)))
    tracker = SubjectTracker(head, TrackConfig(focal_px=focal_px))
    subject = tracker.fit_subject(landmarks_px, *size, keys)
    fit = ClipFit(subject, subject.key_values)
    seen = landmarks_px[list(keys)]
    away = tracker.fitted_px(fit, with_offsets=False) - seen[:, tracker.facemesh_index]
    share = np.linalg.norm(away, axis=-1) / face_height_px(seen)[:, None]
    nearer_m = np.median(tracker.thetas(fit)[:, head.layout.slice("translation")][:, 2])
    return {
        "focal_by_face": by_face,
        "head_m": float(subject.camera.distance_m - nearer_m),
        "misfit_percent": float(100 * np.sqrt((share**2).mean())),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each person or film."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="*", default=[8, 9, 10, 11])
    parser.add_argument("--films", type=Path, nargs="*", default=[])
    parser.add_argument("--json", type=Path, help="also write the figures here")
    chosen = parser.parse_args(arguments)
    head = HeadModel.embedded(torch.float64)
    rows: list[dict[str, Any]] = []
    for who in [*chosen.seeds, *chosen.films]:
        if isinstance(who, Path):
            landmarks_px, width, height = film_landmarks(who)
        else:
            subject = Subject(who, 256, 72, False, STYLES[who % len(STYLES)])
            landmarks_px, width, height = subject.landmarks_px, subject.size, subject.size
        keys = SubjectTracker(head, TrackConfig()).key_positions(landmarks_px, width, height)
        fits = [
            fitted(head, landmarks_px, keys, (width, height), by_face) for by_face in FOCAL_BY_FACE
        ]
        best = min(fits, key=lambda fit: fit["misfit_percent"])
        told = "  ".join(f"{fit['head_m']:.2f} m {fit['misfit_percent']:.3f}" for fit in fits)
        print(f"{who}: {told}  least at {best['head_m']:.2f} m", flush=True)
        rows.append({"who": str(who), "fits": fits, "least": best})
    write_figures(chosen.json, chosen, rows=rows)


if __name__ == "__main__":
    main()
