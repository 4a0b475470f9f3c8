"""Where a drawn avatar looks, beside where the film's person does: irises found in both pictures.

    python benchmarks/quality/gaze.py AVATAR DATASET [--json gaze.json]

draws the held-out frames of a dataset, finds irises on them and on the film's own pictures, and
prints how far they lie apart within their eyes, in eye widths (corner to corner): mean and 95th
percentile; and how well the drawn ones follow the filmed ones sideways and up and down
(correlation). An iris that is not seen in both pictures of a frame leaves the frame out.
"""

import argparse
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from subject import Subject, write_figures

from rgbavatar_ns import Avatar
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.tracking.face.detector import EYE_CORNERS, FaceLandmarker
from rgbavatar_ns.tracking.face.iris import FoundIrises, find_irises


def irises_in_eyes(
    landmarks_px: Float[np.ndarray, "478 2"], irises: FoundIrises
) -> Float[np.ndarray, "2 2"]:
    """Right and left iris from the middle of its eye's corners: along them, across; eye widths."""
    first, second = (landmarks_px[..., list(ends), :] for ends in zip(*EYE_CORNERS))
    along = second - first
    width = np.linalg.norm(along, axis=-1, keepdims=True)
    along = along / width
    across = np.stack([-along[..., 1], along[..., 0]], -1)
    away = (irises.centers - (first + second) / 2) / width
    return np.stack([(away * along).sum(-1), (away * across).sum(-1)], -1)


def gaze_figures(
    drawn: Sequence[UInt8[np.ndarray, "H W 3"]], filmed: Sequence[UInt8[np.ndarray, "H W 3"]]
) -> dict[str, float | int]:
    """The figures of pairs of pictures; frames without a face or irises are left out."""
    pairs: list[Float[np.ndarray, "2 2 2"]] = []
    with closing(FaceLandmarker()) as first, closing(FaceLandmarker()) as second:
        for pictures in zip(drawn, filmed):
            looks = [look(picture) for look, picture in zip((first, second), pictures)]
            faces = [points for points in looks if points is not None]
            irises = [find_irises(*pair) for pair in zip(pictures, faces)]
            if len(faces) == 2 and all(eyes.found.all() for eyes in irises):
                pairs.append(np.array([irises_in_eyes(*eyes) for eyes in zip(faces, irises)]))
    if not pairs:
        raise SystemExit("No irises are found in both pictures of any frame.")
    ours, theirs = np.array(pairs).transpose(1, 0, 2, 3)
    away = np.linalg.norm(ours - theirs, axis=-1)
    axes = [np.corrcoef(a, b)[0, 1] for a, b in zip(ours.mean(1).T, theirs.mean(1).T)]
    return {
        "frames": len(pairs),
        "iris_away_eye_widths": float(away.mean()),
        "worst_iris_away_eye_widths": float(np.percentile(away, 95)),
        "sideways_correlation": float(axes[0]),
        "up_and_down_correlation": float(axes[1]),
    }


def main() -> None:
    """Print the figures of one avatar."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("avatar", type=Path)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    chosen = parser.parse_args()
    dataset = load_dataset(chosen.dataset)
    subject, avatar = Subject.of(dataset, seed=0), Avatar.load(chosen.avatar)
    drawn: list[np.ndarray] = []
    filmed: list[np.ndarray] = []
    for position in dataset.test:
        for pictures, image in zip((drawn, filmed), subject.shown(avatar, [position])):
            pictures.append((image[0] * 255).round().byte().numpy())
    figures = gaze_figures(drawn, filmed)
    for name, value in figures.items():
        print(f"{name} {value:.3f}" if isinstance(value, float) else f"{name} {value}")
    write_figures(chosen.json, chosen, gaze=figures)


if __name__ == "__main__":
    main()
