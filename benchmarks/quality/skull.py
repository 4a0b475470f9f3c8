"""How the fitted skull lies within the person's hair, on procedural people of mixed hair styles.

    python benchmarks/quality/skull.py --seeds 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23

Styles take turns with the seeds. For each person it prints, from landmarks alone and with the
outlines of key frames in mediapipe's matte: rotation error of the skull (mean, degrees) and its
constant pitch, share of the mesh above the chin within the true alpha and within the found matte,
vertices of the scalp that stand out of the true surface with its hair (share in percent, and the
farthest one in mm), distance of the ears in mm, of the whole head's vertices in mm, and CPU seconds
of the fit. Distances are taken where the face is aligned: one camera does not tell depth and size.
"""

import argparse
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from subject import write_figures
from tracker import FACE_FRONT_M, Subject, aligned_to_face, outlines, text

from rgbavatar_ns.drawing.wireframe import mesh_silhouette
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.hair import haired_vertices
from rgbavatar_ns.head.rotations import matrix_to_axis_angle
from rgbavatar_ns.synthetic.performer.hair import SCALP_HAIR, HairStyle, make_hair_piece
from rgbavatar_ns.synthetic.performer.surface import TrueSurface
from rgbavatar_ns.synthetic.performer.wrinkles import WRINKLES
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.detector import CHIN, FOREHEAD
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.image.head_mask import height_above_chin
from rgbavatar_ns.tracking.image.matting import PersonMatte

STYLES: tuple[HairStyle, ...] = get_args(HairStyle)
EVERY = 6
"""Frames that silhouettes and surfaces are compared in."""


def ears(head: HeadModel) -> Bool[np.ndarray, "V"]:
    """Vertices of the embedded head's ears: they stick out beside the eyes' height."""
    x, y, z = head.arrays.v_template.T
    return (np.abs(x) > 0.07) & (np.abs(y - 0.01) < 0.035) & (z < 0)


def outside_m(
    subject: Subject, vertices: Float[np.ndarray, "F V 3"], ours: Float[np.ndarray, "F N 3"]
) -> Float[np.ndarray, "F N"]:
    """How far points lie out of the true surface with its hair; 0 within.

    `vertices` are the true head model's, `ours` the points in the same world, at `EVERY` frame.
    """
    config, person = subject.config, subject.person
    scalp = SCALP_HAIR[config.hair]
    surface = TrueSurface(person.head.arrays, config.seed, config.wrinkles, scalp)
    still = np.zeros(len(WRINKLES))
    rest = person.head(torch.zeros(1, person.head.layout.size), person.identity).numpy()[0]
    piece = make_hair_piece(config.hair, surface.pose(rest, still).vertices, config.seed)
    moments = person.moments(torch.from_numpy(subject.theta[::EVERY]).float())
    found = []
    for moment, head, points in zip(moments, vertices, ours):
        posed = surface.pose(head.astype(np.float32), still)
        shells = [(posed.vertices, posed.normals)]
        if piece is not None:
            worn = piece.mesh.moved(moment.head_rotation, moment.head_shift_m)
            shells.append((worn.vertices, worn.normals))
        away = []
        for places, normals in shells:
            _, nearest = KDTree(places).query(points)
            away.append(((points - places[nearest]) * normals[nearest]).sum(1))
        found.append(np.maximum(np.min(away, axis=0), 0))
    return np.array(found)


def measure(subject: Subject, head: HeadModel, *, with_outlines: bool) -> dict[str, Any]:
    """All figures of one person."""
    tracker = SubjectTracker(head, TrackConfig())
    known = outlines(subject, tracker) if with_outlines else ()
    started = time.process_time()
    size = subject.size
    landmarks, follows = subject.landmarks_px, subject.follows
    fit = tracker.fit(landmarks, follows, size, size, outlines=known, irises=subject.irises)
    seconds = time.process_time() - started
    thetas, camera = tracker.thetas(fit), fit.subject.camera
    turns = [
        np.array([tracker.mesh_landmarks.head_rotation(theta) for theta in one])
        for one in (thetas, subject.theta)
    ]
    off = matrix_to_axis_angle(torch.from_numpy(turns[0] @ turns[1].transpose(0, 2, 1))).numpy()
    with torch.no_grad():
        ours = head(torch.from_numpy(thetas), torch.from_numpy(fit.subject.identity)).numpy()
        real = head(torch.from_numpy(subject.theta), torch.from_numpy(subject.identity)).numpy()
    ours, real = ours[::EVERY], real[::EVERY]
    alpha, matte = _held(subject, head, camera.project(ours))
    eye = np.array([0, subject.camera.height_m, subject.camera.distance_m])
    face = head.arrays.v_template[:, 2] > FACE_FRONT_M
    ratio = camera.focal_px / subject.camera.focal_px
    aligned, _ = aligned_to_face(ours - [0, 0, camera.distance_m], real - eye, face, ratio)
    aligned = aligned + eye
    out_m = outside_m(subject, real, aligned[:, haired_vertices(head.arrays)])
    middles = [points[:, ears(head)].mean(1) for points in (aligned, real)]
    return {
        "rotation_degrees": float(np.degrees(np.linalg.norm(off, axis=1)).mean()),
        "pitch_degrees": float(np.degrees(off[:, 0]).mean()),
        "within_alpha": alpha,
        "within_matte": matte,
        "out_of_hair_percent": float(100 * (out_m > 0).mean()),
        "out_of_hair_mm": float(1e3 * out_m.max()),
        "ears_mm": float(1e3 * np.linalg.norm(middles[0] - middles[1], axis=1).mean()),
        "head_mm": float(1e3 * np.linalg.norm(aligned - real, axis=-1).mean()),
        "fit_cpu_s": seconds,
    }


def _held(
    subject: Subject, head: HeadModel, vertices_px: Float[np.ndarray, "F V 2"]
) -> tuple[float, float]:
    """Share of the mesh above the chin within the true alpha, and within the found matte."""
    arrays, size = head.arrays, subject.size
    with_head = arrays.skinning_weights[:, 0] < 0.5
    faces = arrays.faces[with_head[arrays.faces].all(1)]
    held = []
    with closing(PersonMatte()) as matte:
        for number, points in enumerate(vertices_px):
            picture, alpha = (one[number * EVERY] for one in (subject.pictures, subject.alphas))
            forehead, chin = subject.landmarks_px[number * EVERY][[FOREHEAD, CHIN]]
            mesh = mesh_silhouette(points, faces, size) > 0.5
            mesh &= height_above_chin(forehead, chin, size) > 0
            held.append(
                [(mesh & one).sum() / mesh.sum() for one in (alpha > 127, matte(picture) > 0.5)]
            )
    return tuple(np.mean(held, axis=0).tolist())


def main(arguments: Sequence[str] | None = None) -> None:
    """Print two rows for each person, and how many come up to the mark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(8)))
    parser.add_argument("--hair", choices=STYLES, help="the same for all")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--frames", type=int, default=72)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    chosen = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    head = HeadModel.embedded(dtype=torch.float64)
    rows: list[dict[str, Any]] = []
    for seed in chosen.seeds:
        hair = chosen.hair or STYLES[seed % len(STYLES)]
        subject = Subject(seed, chosen.size, chosen.frames, False, hair)
        for known in (False, True):
            row = {"seed": seed, "hair": hair, "outlines": known}
            rows.append(row | measure(subject, head, with_outlines=known))
            print(text(rows[-1]), flush=True)
    for known in (False, True):
        own = [row for row in rows if row["outlines"] == known]
        means = {name: float(np.mean([abs(r[name]) for r in own])) for name in list(own[0])[3:]}
        good = sum(row["rotation_degrees"] < 1.5 for row in own)
        held = sum(min(row["within_alpha"], row["within_matte"]) >= 0.985 for row in own)
        print(f"outlines {known}: rotation below 1.5 {good}, mesh held {held} of {len(own)}")
        print(text(means))
    write_figures(chosen.json, chosen, rows=rows)


if __name__ == "__main__":
    main()
