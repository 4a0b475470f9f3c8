"""Faces that a film does not have, of any avatar: a sheet to look at, without truth.

    python benchmarks/quality/moved.py AVATAR DATASET [AVATAR DATASET ...] --picture moved.png

The calmest held-out frame of each dataset makes expressions one by one, a jaw that opens in three
steps, a smile, pursed lips, closed eyes, bared teeth, beside itself and turned by 25 degrees. A row
an avatar; scores say little of what people see here first (`beyond.py` has them).
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from subject import avatars_and_datasets, write_picture

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.orbit import head_centre, orbit
from rgbavatar_ns.avatar.storage.statistics import neutral_frame
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.head.arkit import arkit_coefficients, arkit_map

FACES: dict[str, dict[str, float]] = {
    "as filmed": {},
    "jaw .35": {"jawOpen": 0.35},
    "jaw .7": {"jawOpen": 0.7},
    "jaw 1": {"jawOpen": 1.0},
    "smile": {"mouthSmile*": 0.8},
    "pursed lips": {"mouthPucker": 0.8},
    "closed eyes": {"eyeBlink*": 1.0},
    "bared teeth": {"mouthUpperUp*": 0.8, "mouthLowerDown*": 0.8},
}
"""ARKit's coefficients over those of the frame; "*" stands for both sides."""
_TURNS_DEG = (-25.0, 25.0)
_HALF_HEAD_M, _CELL = 0.1, 200


def by_sides(face: dict[str, float]) -> dict[str, float]:
    """A face by ARKit's own names."""
    both = {name: ("Left", "Right") if name.endswith("*") else ("",) for name in face}
    return {name.rstrip("*") + end: face[name] for name, ends in both.items() for end in ends}


@torch.no_grad()
def sheet(avatar: Avatar, data: Path) -> Float[np.ndarray, "height width 3"]:
    """All faces of the calmest held-out frame, then this frame turned; white background."""
    dataset, table = load_dataset(data), arkit_map(avatar.head.arrays)
    held_out = list(dataset.test) or list(dataset.train)
    theta, names = dataset.theta[held_out], avatar.head.arrays.expression_names
    calm = neutral_frame(theta, avatar.layout, names)
    frame = held_out[int((theta == calm).all(1).nonzero()[0, 0])]
    camera = dataset.cameras.select([frame % len(dataset.cameras.focal_px)])
    faces = [arkit_coefficients(by_sides(face)) for face in FACES.values()]
    cells = [(calm + table.theta(face), camera) for face in faces]
    centre = head_centre(avatar, calm[None]).to(camera.world_to_camera)
    for turn in _TURNS_DEG:
        cells.append((calm, orbit(camera, centre, torch.tensor([turn]), torch.zeros(1))))
    drawn = [avatar.render(theta[None], seen, torch.ones(3)).image[0] for theta, seen in cells]
    middle = camera.project(centre.view(1, 1, 3))[0, 0].tolist()
    side = round(2 * _HALF_HEAD_M * float(camera.focal_px[0, 0] / camera.placed(centre)[0, 0, 2]))
    heads = [cv2.getRectSubPix(image.clamp(0, 1).numpy(), (side, side), middle) for image in drawn]
    return np.concatenate([cv2.resize(head, (_CELL, _CELL)) for head in heads], 1)


def main() -> None:
    """Draw a row for each avatar."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("pairs", type=Path, nargs="+", metavar="AVATAR DATASET")
    parser.add_argument("--picture", type=Path, required=True, help="the sheet to write")
    arguments = parser.parse_args()
    pairs = avatars_and_datasets(parser, arguments.pairs)
    write_picture(
        arguments.picture,
        np.concatenate([sheet(Avatar.load(path), data) for path, data in pairs]),
    )
    print(f"{arguments.picture}: {', '.join(FACES)}, turned by -25 and 25 degrees")


if __name__ == "__main__":
    main()
