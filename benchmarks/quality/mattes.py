"""How near the mattes of a clip, and those of a stream, come to the truth.

    python benchmarks/quality/mattes.py --seeds 5 6 --json mattes.json
    python benchmarks/quality/mattes.py --seeds 5 6 --hair long

For each procedural person (dark hair, short or as `--hair` says, with loose strands; shoulders) and
each room (a light wall, a busy shelf, dark on dark) it films a clip with a webcam's noise and
compression, tracks it, and prints for each way to find mattes: the mean absolute error of alpha in
percent, in the unsure band (where the truth or a stream's matte is between .02 and .98, and 3
pixels of 480 around) and over the whole image; its flicker (mean absolute change of the error from
frame to frame in the band, percent); and the error of the colour on a white and on a green
background in the band, in levels.

"frame" is a stream's way: plain segmentation and guided filter, each frame by itself. "clip" is
what `rgbavatar track` writes. "colours" is the band's error of each pixel by itself where the true
colours of person and room are told, before a camera that stands: what noise and compression leave,
and what only a guess about neighbours can undercut. Each room is filmed twice: by a camera that
stands, and by one in a hand.
"""

import argparse
import json
import tempfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from rooms import ROOMS, FilmedRoom, Performance

from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.drawing.compositing import composite_bytes
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.synthetic.performer.hair import HairStyle
from rgbavatar_ns.tracking import TrackConfig, track_video
from rgbavatar_ns.tracking.image.body_end import BodyEnd
from rgbavatar_ns.tracking.image.crop import SquareCrop
from rgbavatar_ns.tracking.image.matting import (
    PersonMatte,
    foreground_color,
    straight_rgba,
)
from rgbavatar_ns.tracking.input.video import FrameSource

_SIZE, _UNSURE, _AROUND = 480, 0.02, 7
_NEW_ROOMS = {"white": (1.0, 1.0, 1.0), "green": (0.24, 0.78, 0.24)}
_HAND_PX = 4.0

Pictures = list[UInt8[np.ndarray, "S S 4"]]


def cropped(crop: SquareCrop, rgba: UInt8[np.ndarray, "H W 4"]) -> UInt8[np.ndarray, "S S 4"]:
    """The crop of a straight-alpha picture, as light adds up."""
    light = rgba.astype(np.float32)
    light[..., :3] *= light[..., 3:] / 255
    held = crop.apply(light)
    held[..., :3] /= np.maximum(held[..., 3:] / 255, 1e-6)
    return np.clip(held + 0.5, 0, 255).astype(np.uint8)


def alpha(picture: UInt8[np.ndarray, "S S 4"]) -> np.ndarray:
    """In [0, 1]."""
    return picture[..., 3].astype(np.float32) / 255


def unsure(truth: Pictures, plain: Pictures) -> list[Bool[np.ndarray, "S S"]]:
    """Where the truth or the plain matte is soft, and around."""
    soft = [
        (np.abs(np.stack([alpha(a), alpha(b)]) - 0.5) < 0.5 - _UNSURE).any(0)
        for a, b in zip(truth, plain)
    ]
    kernel = np.ones((_AROUND, _AROUND), np.uint8)
    return [cv2.dilate(one.astype(np.uint8), kernel) > 0 for one in soft]


def figures(
    found: Pictures, truth: Pictures, bands: list[Bool[np.ndarray, "S S"]], inside: np.ndarray
) -> dict[str, float]:
    """All errors of one way."""
    off = [alpha(a) - alpha(b) for a, b in zip(found, truth)]
    bands = [band & inside for band in bands]
    row = {
        "band": 100 * np.mean([np.abs(one)[band].mean() for one, band in zip(off, bands)]),
        "whole": 100 * np.mean([np.abs(one)[inside].mean() for one in off]),
        "flicker": 100
        * np.mean([np.abs(b - a)[band].mean() for a, b, band in zip(off, off[1:], bands[1:])]),
    }
    for name, color in _NEW_ROOMS.items():
        shown = [[composite_bytes(one, color).astype(float) for one in p] for p in (found, truth)]
        apart = [np.abs(a - b)[band].mean() for a, b, band in zip(*shown, bands)]
        row[name] = np.mean(apart)
    return {name: float(value) for name, value in row.items()}


def from_true_colors(
    image: UInt8[np.ndarray, "S S 3"],
    truth: UInt8[np.ndarray, "S S 4"],
    room: Float[np.ndarray, "S S 3"],
) -> UInt8[np.ndarray, "S S 4"]:
    """The truth with the alpha that the film's own colour gives, pixel by pixel."""
    seen = (truth[..., 3:] > _UNSURE * 255).astype(np.float32)
    near = (_AROUND, _AROUND)
    person = truth[..., :3].astype(np.float32)
    around = cv2.blur(person * seen, near) / (cv2.blur(seen, near)[..., None] + 1e-6)
    towards = np.where(seen > 0, person, around) - room
    share = ((image - room) * towards).sum(-1) / ((towards * towards).sum(-1) + 1e-3)
    return straight_rgba(truth[..., :3], np.clip(share, 0, 1).astype(np.float32))


def above_the_end(
    dataset: TrackedDataset, inside: Bool[np.ndarray, "S S"]
) -> Bool[np.ndarray, "S S"]:
    """Where no frame shows less of the body than was filmed."""
    with torch.no_grad():
        vertices = HeadModel(dataset.arrays)(dataset.theta, dataset.identity)
    frames_px = dataset.cameras.project(vertices).double().numpy()
    end = BodyEnd.of(dataset.arrays, list(frames_px), inside)
    return np.min([end.shown(px, len(inside)) for px in frames_px], axis=0) >= 1


def measure(film: FilmedRoom, folder: Path, hand_px: float) -> dict[str, Any]:
    """Film, track and compare one clip."""
    clip, dst = folder / "clip.mp4", folder / "set"
    film.write(clip, hand_px)
    config = TrackConfig(image_size=_SIZE)
    dataset = track_video(clip, dst, config)
    report = json.loads((dst / "tracking.json").read_text())
    crop = SquareCrop(**report["crop"], size=_SIZE)
    left_out = {frame for frames in report["rejected"].values() for frame in frames}
    frames = [k for k in range(report["frames_read"]) if k not in left_out]
    truth = [cropped(crop, one) for k, one in enumerate(film.truth(hand_px)) if k in set(frames)]
    found = [dataset.read_image(place) for place in range(len(frames))]
    plain, told, inside = [], [], np.ones((_SIZE, _SIZE), bool)
    room = crop.apply(film.behind().astype(np.float32))
    with closing(PersonMatte()) as matte:
        for frame in FrameSource.open(clip).read(set(frames).__contains__):
            image, inside = crop.apply(frame.image_rgb), crop.inside(frame.width, frame.height)
            level = matte(image)
            plain.append(straight_rgba(foreground_color(image, level), level))
            told.append(from_true_colors(image, truth[len(told)], room))
    # A body is made to end: that is no error of the matte.
    inside = inside & above_the_end(dataset, inside)
    bands = unsure(truth, plain)
    return {
        "background": report["background"],
        "known": report["background_known_share"],
        "pictures_per_second": report["stages"]["pictures"]["frames_per_second"],
        "colours": figures(told, truth, bands, inside)["band"] if hand_px == 0 else None,
        "frame": figures(plain, truth, bands, inside),
        "clip": figures(found, truth, bands, inside),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print two rows for each person, room and camera."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="+", default=[5, 6])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--rooms", nargs="+", default=list(ROOMS), choices=list(ROOMS))
    parser.add_argument("--hair", default="short", choices=get_args(HairStyle))
    parser.add_argument("--json", type=Path, help="also write the figures here")
    chosen = parser.parse_args(arguments)
    rows = []
    for seed in chosen.seeds:
        performance = Performance(seed, chosen.frames, supersampling=2, hair=chosen.hair)
        for name in chosen.rooms:
            for hand_px in (0.0, _HAND_PX):
                with tempfile.TemporaryDirectory() as folder:
                    film = FilmedRoom(performance, ROOMS[name], seed)
                    row = measure(film, Path(folder), hand_px)
                filmed = {"seed": seed, "hair": chosen.hair, "room": name, "hand_px": hand_px}
                rows.append({**filmed, **row})
                for way in ("frame", "clip"):
                    errors = "  ".join(f"{key} {value:.2f}" for key, value in row[way].items())
                    case = f"{seed} {chosen.hair} {name} {hand_px:g} px ({row['background']})"
                    print(f"{case} {way}: {errors}")
                if row["colours"] is not None:
                    print(f"    true colours: band {row['colours']:.2f}")
                print(
                    f"    band x {row['clip']['band'] / row['frame']['band']:.2f}, "
                    f"{row['pictures_per_second']:.1f} pictures/s",
                    flush=True,
                )
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
