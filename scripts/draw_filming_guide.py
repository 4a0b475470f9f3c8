"""Draw the picture of docs/filming.md: what to film, and what ruins a film.

    python scripts/draw_filming_guide.py [--seed 4]

writes `docs/filming.png`: the procedural person before a plain wall, in frames as a webcam has
them; in the first two rows what an avatar needs, in the last one what to avoid.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from rgbavatar_ns.drawing.contact_sheet import contact_sheet, labelled, scaled
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson

PLACE = Path(__file__).parents[1] / "docs" / "filming.png"
WIDTH, HEIGHT, COLUMNS = 240, 180, 4
HEAD_PX = 172
"""Side of the square that the head is drawn in, in a good frame."""
BELOW = 0.02
"""Share of that square below the frame, where the drawn body ends."""
NEEDED: dict[str, Mapping[str, float]] = {
    "good: face, light, distance": {},
    "turn left": {"yaw": 30},
    "turn right": {"yaw": -30},
    "look up": {"pitch": -15},
    "look down": {"pitch": 15},
    "mouth wide open": {"jaw": 19, "mouthFunnel": 0.2},
    "smile": {
        **{f"mouthSmile{side}": 0.8 for side in ("Left", "Right")},
        **{f"cheekSquint{side}": 0.6 for side in ("Left", "Right")},
        **{f"mouthUpperUp{side}": 0.6 for side in ("Left", "Right")},
        **{f"mouthLowerDown{side}": 0.3 for side in ("Left", "Right")},
    },
    "eyes closed": {f"eyeBlink{side}": 1.0 for side in ("Left", "Right")},
}
RUINED = ("too dark", "too small", "blurred", "cut off")


def theta_of(
    layout: ThetaLayout, names: tuple[str, ...], pose: Mapping[str, float]
) -> torch.Tensor:
    """Angles in degrees by name, and expressions."""
    theta = torch.zeros(layout.size)
    for name, value in pose.items():
        if name in ("yaw", "pitch"):
            theta[layout.slice("neck").start + ("pitch", "yaw").index(name)] = np.radians(value)
        elif name == "jaw":
            theta[layout.slice("jaw").start] = np.radians(value)
        else:
            theta[layout.slice("expression").start + names.index(name)] = value
    return theta


def before_a_wall(head_rgba: UInt8[np.ndarray, "S S 4"], side: int) -> UInt8[np.ndarray, "H W 3"]:
    """A frame, blue first, with the head drawn in a square that the lower edge cuts a little."""
    top = HEIGHT - side + round(BELOW * side)
    shade = np.linspace(205, 165, WIDTH)[None, :, None]
    frame = np.tile(shade * (0.97, 0.98, 1.0), (HEIGHT, 1, 1))
    image = scaled(head_rgba, side / len(head_rgba)).astype(np.float64)
    left = (WIDTH - side) // 2
    rows = slice(max(top, 0), min(top + side, HEIGHT))
    part = image[rows.start - top : rows.stop - top]
    alpha = part[..., 3:] / 255
    room = frame[rows, left : left + side]
    frame[rows, left : left + side] = room * (1 - alpha) + part[..., 2::-1] * alpha
    return frame.round().astype(np.uint8)


def tiles(seed: int) -> list[UInt8[np.ndarray, "H W 3"]]:
    """What is needed, then what ruins a film."""
    person = DemoPerson.of(DemoConfig(image_size=256, seed=seed, glasses=False))
    layout, names = person.head.layout, person.head.arrays.expression_names
    theta = torch.stack([theta_of(layout, names, pose) for pose in NEEDED.values()])
    heads = list(person.draw(theta))
    good = [before_a_wall(head, HEAD_PX) for head in heads]
    shaken = cv2.blur(good[0], (17, 3))
    ruined = [
        (good[0] * 0.16).astype(np.uint8),
        before_a_wall(heads[0], HEAD_PX // 3),
        np.asarray(shaken),
        before_a_wall(heads[0], WIDTH),
    ]
    labels = [*NEEDED, *(f"not: {why}" for why in RUINED)]
    return [labelled(tile, label) for tile, label in zip([*good, *ruined], labels)]


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=4)
    sheet = contact_sheet(tiles(parser.parse_args().seed), COLUMNS)
    with atomic_write(PLACE) as partial:
        partial.write_bytes(
            cv2.imencode(".png", sheet, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
        )
    print(f"{PLACE.name}: {PLACE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
