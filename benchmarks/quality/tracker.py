"""How near the tracker comes to the truth on the procedural subject.

    python benchmarks/quality/tracker.py --seeds 0 1 2 --sizes 256 512 --json tracker.json

For each subject it renders a performance, finds landmarks on the images with mediapipe, fits the
head model and prints: rotation error of the skull (mean, degrees; its constant part as pitch, yaw,
roll), error across the image plane in percent of the distance, distance of vertices of the face
and of the whole head in mm (position, depth and size of the head aligned: one camera does not
tell them), correlation of the expression coefficients that are active (all of them pooled, and the
median of each one's own), of jaw and of gaze, the gaze's error (mean angle between an eye's found
and true direction in the skull, degrees, where lids are open; its constant part as pitch and yaw;
the error without each eye's constant part, of which pictures tell little), how far irises found in
the pictures lie from the true ones and how far the fitted mesh's do (mean, eye widths, lids open),
the share of open eyes with a found iris and of frames whose gaze is at a bound, how much the fit's
second differences shrink against a fit without smoothing, its lag in frames, and CPU time of the
fit. Once with the camera's true focal length and once with the one that is taken without it.
"""

import argparse
import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson
from rgbavatar_ns.synthetic.performer.hair import HairStyle
from rgbavatar_ns.synthetic.performer.performance import perform
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.detector import FaceLandmarker, eye_widths_px
from rgbavatar_ns.tracking.face.iris import FoundIrises, find_irises
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.irises import iris_places
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead
from rgbavatar_ns.tracking.fit.outline import PersonOutline
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.image.crop import steady_crop
from rgbavatar_ns.tracking.image.matting import PersonMatte
from rgbavatar_ns.tracking.image.outlines import OUTLINE_PX, levels, person_outline
from rgbavatar_ns.tracking.verify.gaze import gaze_quality

FRAMES_PER_SECOND = 12.0
FACE_FRONT_M = 0.02
"""Vertices of the template in front of this are the face."""
OPEN_LIDS = 0.35
"""Blinks below this leave the iris to be seen."""


class Subject:
    """A procedural person with its true parameters and the landmarks found on its images."""

    def __init__(
        self, seed: int, size: int, frames: int, glasses: bool, hair: HairStyle = "short"
    ) -> None:
        config = DemoConfig(
            image_size=size,
            num_frames=frames,
            num_test_frames=frames // 4,
            seed=seed,
            frames_per_second=FRAMES_PER_SECOND,
            glasses=glasses,
            hair=hair,
            supersampling=2,
        )
        person = DemoPerson.of(config)
        layout, names = person.head.layout, person.head.arrays.expression_names
        acted = perform(layout, names, frames, frames // 4, FRAMES_PER_SECOND, seed)
        self.size, self.camera = size, person.camera
        self.identity = person.identity.double().numpy()
        row, column = np.mgrid[:size, :size] / size
        room = np.stack([90 + 60 * column, 110 + 40 * row, 130 - 30 * column], -1)
        found: list[np.ndarray] = []
        kept: list[int] = []
        pictures: list[np.ndarray] = []
        alphas: list[np.ndarray] = []
        with closing(FaceLandmarker()) as landmarker:
            images = person.draw(torch.from_numpy(acted).float())
            for number, image in enumerate(images):
                alpha = image[..., 3:] / 255
                picture = image[..., :3] * alpha + room * (1 - alpha)
                pixels = picture.round().astype(np.uint8)
                points = landmarker(pixels)
                if points is not None:
                    found.append(points)
                    pictures.append(pixels)
                    alphas.append(image[..., 3])
                    kept.append(number)
        self.theta = acted[kept]
        self.config, self.person = config, person
        self.pictures, self.alphas = np.array(pictures), np.array(alphas)
        self.landmarks_px = np.array(found)
        self.irises = FoundIrises.stacked(
            [find_irises(*seen) for seen in zip(self.pictures, self.landmarks_px)]
        )
        self.follows = [False, *(np.diff(kept) == 1).tolist()]
        self.lost = frames - len(kept)


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Of all entries; 0 where one of them never changes."""
    if min(first.std(), second.std()) < 1e-9:
        return 0.0
    return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])


def lag_frames(found: Float[np.ndarray, "F"], true: Float[np.ndarray, "F"]) -> int:
    """By how many frames `found` comes late: the shift of the best correlation, up to 3."""
    shifts = range(-3, 4)
    inner = slice(3, -3)
    scores = [correlation(np.roll(found, -shift)[inner], true[inner]) for shift in shifts]
    return shifts[int(np.argmax(scores))]


def lids_open(head: HeadModel, true: Float[np.ndarray, "F H"]) -> Bool[np.ndarray, "F"]:
    """In which frames neither eye blinks."""
    first = head.layout.slice("expression").start
    lids = [first + k for k, name in enumerate(head.arrays.expression_names) if "Blink" in name]
    return (true[:, lids] < OPEN_LIDS).all(1)


def gaze_errors(
    head: HeadModel, theta: Float[np.ndarray, "F H"], true: Float[np.ndarray, "F H"]
) -> dict[str, Any]:
    """Angles between found and true directions of both eyes; closed ones are not counted."""
    seen = lids_open(head, true)
    angles, off = [], []
    for name in ("left_eye", "right_eye"):
        both = [torch.from_numpy(one[seen][:, head.layout.slice(name)]) for one in (theta, true)]
        found, real = (axis_angle_to_matrix(one)[..., 2] for one in both)
        off.append(torch.rad2deg(torch.acos((found * real).sum(-1).clamp(-1, 1))))
        pitch_yaw = [
            torch.stack([-torch.asin(one[:, 1]), torch.atan2(one[:, 0], one[:, 2])], -1)
            for one in (found, real)
        ]
        angles.append(torch.rad2deg(pitch_yaw[0] - pitch_yaw[1]))
    apart = torch.stack(angles)
    varying = apart - apart.mean(1, keepdim=True)
    return {
        "gaze_degrees": float(torch.stack(off).mean()),
        "gaze_bias_degrees": apart.mean((0, 1)).numpy().round(2).tolist(),
        "gaze_varying_degrees": float(varying.norm(dim=-1).mean()),
    }


def true_irises_px(subject: "Subject", head: HeadModel) -> Float[np.ndarray, "F 2 2"]:
    """Where the middles of the person's right and left iris are in its pictures."""
    irises, camera = LandmarkHead(head, *iris_places(head.arrays)), subject.camera
    eye_m = np.array([0.0, camera.height_m, camera.distance_m])
    away = np.array([irises.points(theta, subject.identity) for theta in subject.theta]) - eye_m
    return away[..., :2] * (1, -1) * camera.focal_px / -away[..., 2:] + camera.size / 2


def iris_errors(
    subject: "Subject", tracker: SubjectTracker, fit: ClipFit, head: HeadModel
) -> dict[str, float]:
    """How far found irises and the fitted mesh's lie from the true ones, eye widths."""
    true_px, found = true_irises_px(subject, head), subject.irises
    seen = np.repeat(lids_open(head, subject.theta)[:, None], 2, axis=1)
    widths = eye_widths_px(subject.landmarks_px)
    drawn, picture = (
        np.linalg.norm(irises - true_px, axis=-1) / widths
        for irises in (tracker.irises_px(fit), found.centers)
    )
    return {
        "irises_found_share": float(found.found[seen].mean()),
        "iris_found_off": float(picture[seen & found.found].mean()),
        "iris_drawn_off": float(drawn[seen].mean()),
    }


def jitter(values: Float[np.ndarray, "F P"]) -> float:
    """Mean square of second differences."""
    return float(np.square(np.diff(values, 2, axis=0)).mean())


def aligned_to_face(
    ours: Float[np.ndarray, "F V 3"],
    real: Float[np.ndarray, "F V 3"],
    face: Bool[np.ndarray, "V"],
    focal_ratio: float,
) -> tuple[Float[np.ndarray, "F V 3"], Float[np.ndarray, "F"]]:
    """Vertices moved and scaled so that the face has its true place and size, from the cameras.

    One camera does not tell depth and size. Second: how far apart the faces' middles are across
    the image, as a share of the distance. `focal_ratio`: found by true focal length.
    """
    our_middle, real_middle = ours[:, face].mean(1), real[:, face].mean(1)
    # The pixel of the face's middle, seen at its true depth through the true camera.
    across = our_middle[:, :2] / our_middle[:, 2:] * focal_ratio
    across = across * real_middle[:, 2:]
    away = np.linalg.norm(across - real_middle[:, :2], axis=1) / -real_middle[:, 2]
    extent = [
        np.linalg.norm(points[:, face] - middle[:, None], axis=-1).mean()
        for points, middle in ((ours, our_middle), (real, real_middle))
    ]
    placed = np.concatenate([across, real_middle[:, 2:]], 1)
    return (ours - our_middle[:, None]) * (extent[1] / extent[0]) + placed[:, None], away


def vertex_errors(
    head: HeadModel,
    found: tuple[np.ndarray, np.ndarray, float, float],
    true: tuple[np.ndarray, np.ndarray, float, float, float],
) -> dict[str, float]:
    """Errors of position and shape; (theta, identity, focal_px, distance_m[, height_m]) each."""
    theta, identity, focal_px, distance_m = found
    true_theta, true_identity, true_focal_px, true_distance_m, height_m = true
    with torch.no_grad():
        ours = head(torch.from_numpy(theta), torch.from_numpy(identity)).numpy()
        real = head(torch.from_numpy(true_theta), torch.from_numpy(true_identity)).numpy()
    ours = ours - [0, 0, distance_m]
    real = real - [0, height_m, true_distance_m]
    face = head.arrays.v_template[:, 2] > FACE_FRONT_M
    aligned, away = aligned_to_face(ours, real, face, focal_px / true_focal_px)
    error_mm = np.linalg.norm(aligned - real, axis=-1) * 1e3
    return {
        "translation_percent": float(100 * away.mean()),
        "face_mm": float(error_mm[:, face].mean()),
        "head_mm": float(error_mm.mean()),
    }


def outlines(subject: Subject, tracker: SubjectTracker) -> list[PersonOutline | None]:
    """The person's outlines in the key frames, as `rgbavatar track` finds them."""
    crop = steady_crop(subject.landmarks_px, subject.size, subject.size, OUTLINE_PX)
    keys = tracker.key_positions(subject.landmarks_px, subject.size, subject.size)
    with closing(PersonMatte()) as matte:
        mattes = [levels(matte(crop.apply(subject.pictures[key]))) for key in keys]
    return [person_outline(m, crop, subject.landmarks_px[key]) for m, key in zip(mattes, keys)]


def measure(subject: Subject, head: HeadModel, *, known_focal: bool) -> dict[str, Any]:
    """All figures of one subject."""
    config = TrackConfig(focal_px=subject.camera.focal_px if known_focal else None)
    tracker = SubjectTracker(head, config)
    known, size = outlines(subject, tracker), subject.size
    started = time.process_time()
    landmarks, follows, irises = subject.landmarks_px, subject.follows, subject.irises
    fit = tracker.fit(landmarks, follows, size, size, outlines=known, irises=irises)
    seconds = time.process_time() - started
    rough = SubjectTracker(head, replace(config, temporal_weight=0.0))
    unsmoothed = rough.fit(landmarks, follows, size, size, outlines=known, irises=irises)
    theta, true, layout = tracker.thetas(fit), subject.theta, head.layout
    turns = [np.array([tracker.mesh_landmarks.head_rotation(t) for t in x]) for x in (theta, true)]
    off = matrix_to_axis_angle(torch.from_numpy(turns[0] @ turns[1].transpose(0, 2, 1))).numpy()
    off_degrees = np.degrees(off)
    expression = layout.slice("expression")
    fitted_columns = set(tracker.cost.parameters.columns.tolist())
    active = [
        column
        for column in range(expression.start, expression.stop)
        if column in fitted_columns and true[:, column].std() > 0.05
    ]
    jaw, eye = layout.slice("jaw").start, layout.slice("left_eye").start + 1
    camera, real = fit.subject.camera, subject.camera
    yaw = [np.arctan2(turn[:, 0, 2], turn[:, 2, 2]) for turn in turns]
    return {
        "rotation_degrees": float(np.linalg.norm(off_degrees, axis=1).mean()),
        "rotation_bias_degrees": off_degrees.mean(0).round(2).tolist(),
        **vertex_errors(
            head,
            (theta, fit.subject.identity, camera.focal_px, camera.distance_m),
            (true, subject.identity, real.focal_px, real.distance_m, real.height_m),
        ),
        "expression_pooled": correlation(theta[:, active], true[:, active]),
        "expression_median": float(
            np.median([correlation(theta[:, column], true[:, column]) for column in active])
        ),
        "jaw": correlation(theta[:, jaw], true[:, jaw]),
        "gaze": correlation(theta[:, eye], true[:, eye]),
        **gaze_errors(head, theta, true),
        **iris_errors(subject, tracker, fit, head),
        "gaze_at_bound": gaze_quality(tracker, fit, landmarks, irises)["gaze_at_bound_share"],
        "jitter_ratio": jitter(fit.values) / jitter(unsmoothed.values),
        "lag_frames": lag_frames(yaw[0], yaw[1]),
        "fit_cpu_ms": 1e3 * seconds / len(true),
        "lost_frames": subject.lost,
    }


def text(row: dict[str, Any]) -> str:
    """One line of figures."""
    return "  ".join(
        f"{name} {value:.2f}" if isinstance(value, float) else f"{name} {value}"
        for name, value in row.items()
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one row for each subject and size."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512])
    parser.add_argument("--frames", type=int, default=72)
    parser.add_argument("--glasses", action="store_true", help="the person wears glasses")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    chosen = parser.parse_args(arguments)
    head = HeadModel.embedded(dtype=torch.float64)
    rows = []
    for seed in chosen.seeds:
        for size in chosen.sizes:
            subject = Subject(seed, size, chosen.frames, chosen.glasses)
            for known in (True, False):
                row = {"seed": seed, "size": size, "focal_known": known}
                rows.append(row | measure(subject, head, known_focal=known))
                print(text(rows[-1]), flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
