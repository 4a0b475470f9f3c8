"""What an avatar is worth beyond its film: turned, smiling, driven by others.

    python benchmarks/quality/beyond.py --seeds 3 4 5 --json beyond.json --pictures beyond

A procedural person is filmed within a narrow range (`situations.py`) and scored on truth beyond it,
in dB over the full frame, for avatars with K = 20 bases (ours), without the surface prior (the
paper's setting), with K = 0, and trained on everything, which tells what could be reached.
"closed" is the share of the gap between the paper's setting and the last that ours closes. Holes
and coloured noise of the turned head, which need no truth, are told as `turned.py` tells them.
"""

import argparse
import statistics
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.progress import track
from situations import FilmedPerson, Shots
from subject import BATCH_SIZE, write_figures, write_picture
from turned import tell_turned, turned

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.metrics import psnr
from rgbavatar_ns.avatar.training import (
    TrainingBatch,
    TrainingOptions,
    TrainingStep,
    fit,
    make_optimizer,
)
from rgbavatar_ns.data import OfflineOrder
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float

_LAST_RATE = 0.1
_SHOWN = 6
_BESIDE = (2, 4, 5, 6)
"""Situations that `beside` shows: turns of 30 and 60 degrees, the back, an open mouth."""


@dataclass(frozen=True)
class Variant:
    """How an avatar is trained."""

    surface_prior: bool = True
    num_bases: int = 20
    on_everything: bool = False


VARIANTS = {
    "paper": Variant(surface_prior=False),
    "ours": Variant(),
    "K = 0": Variant(num_bases=0),
    "everything": Variant(on_everything=True),
}


def train(filmed: FilmedPerson, variant: Variant, steps: int, seed: int) -> Avatar:
    """Train as `rgbavatar-tiny` does."""
    shots = filmed.everything if variant.on_everything else filmed.film
    config = AvatarConfig(
        uv_resolution=128, scale_from_texel_spacing=True, num_bases=variant.num_bases
    )
    avatar = Avatar(filmed.person.head, filmed.person.identity, config, seed=seed)
    optimizer = make_optimizer(avatar)
    first_rates = [group["lr"] for group in optimizer.param_groups]
    order = OfflineOrder(range(len(shots.theta)), BATCH_SIZE, seed)
    options = TrainingOptions(seed=seed, surface_prior=variant.surface_prior)

    def batch(step: int) -> TrainingBatch:
        for group, rate in zip(optimizer.param_groups, first_rates):
            group["lr"] = rate * _LAST_RATE ** (step / steps)
        chosen = list(order.batch(step))
        return TrainingBatch(shots.theta[chosen], filmed.camera, shots.images_rgba[chosen])

    fit(TrainingStep(avatar, optimizer, options), batch, track(range(steps), "training"))
    return avatar


@torch.no_grad()
def score(avatar: Avatar, filmed: FilmedPerson, shots: Shots) -> float:
    """Mean PSNR in dB: full frame, black background."""
    found: list[float] = []
    for theta, images in zip(shots.theta.split(8), shots.images_rgba.split(8)):
        image = avatar.render(theta, filmed.camera).image.clamp(0, 1)
        found += psnr(image, composite(rgba_to_float(images), torch.zeros(3))).tolist()
    return statistics.fmean(found)


@torch.no_grad()
def picture(avatar: Avatar | None, filmed: FilmedPerson, path: Path) -> None:
    """Some frames of each situation in a row: the avatar's, or the truth."""
    rows = []
    for shots in filmed.scored.values():
        chosen = torch.linspace(0, len(shots.theta) - 1, _SHOWN).long()
        white = torch.ones(3)
        images = composite(rgba_to_float(shots.images_rgba[chosen]), white)
        if avatar is not None:
            images = avatar.render(shots.theta[chosen], filmed.camera, white).image
        rows.append(torch.cat(list(images.clamp(0, 1)), 1))
    write_picture(path, torch.cat(rows).numpy())


def beside(folder: Path, seed: int) -> None:
    """Truth, the paper's way and ours beside each other, from pictures that are there."""
    sheets = [cv2.imread(str(folder / f"{seed} {name}.png")) for name in ("truth", "paper", "ours")]
    size = sheets[0].shape[1] // _SHOWN
    cells = [
        sheet[row * size : (row + 1) * size, column * size : (column + 1) * size]
        for row in _BESIDE
        for sheet in sheets
        for column in (0, _SHOWN - 1)
    ]
    wide = 2 * len(sheets)
    rows = [np.concatenate(cells[k : k + wide], 1) for k in range(0, len(cells), wide)]
    cv2.imwrite(str(folder / f"{seed} beside.png"), np.concatenate(rows))


def tell(title: str, rows: dict[str, dict[str, float]]) -> None:
    """Print a table: a situation a row, a variant a column, and what ours closes."""
    print(f"{title:<18}" + "".join(f"{name:>12}" for name in rows) + f"{'closed':>10}")
    for situation in rows["ours"]:
        cells = [row[situation] for row in rows.values()]
        gap = rows["everything"][situation] - rows["paper"][situation]
        closed = (rows["ours"][situation] - rows["paper"][situation]) / gap if gap > 0.5 else None
        told = f"{closed:>10.0%}" if closed is not None else f"{'-':>10}"
        print(f"{situation:<18}" + "".join(f"{cell:>12.2f}" for cell in cells) + told, flush=True)


def main() -> None:
    """Run all seeds, print a table each, then the means."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 4, 5])
    parser.add_argument("--light", choices=["head", "room"], default="head")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of all situations")
    arguments = parser.parse_args()
    seeds: dict[str, dict[str, dict[str, float]]] = {}
    looks: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    means: dict[str, dict[str, float]] = {}
    for seed in arguments.seeds:
        filmed = FilmedPerson.of(seed, arguments.image_size, arguments.light)
        rows: dict[str, dict[str, float]] = {}
        for name, variant in VARIANTS.items():
            avatar = train(filmed, variant, arguments.steps, seed)
            rows[name] = {k: score(avatar, filmed, shots) for k, shots in filmed.scored.items()}
            held_out = filmed.scored["film"].theta[::10]
            looks.setdefault(str(seed), {})[name] = turned(avatar, held_out, filmed.camera)
            if arguments.pictures:
                picture(avatar, filmed, arguments.pictures / f"{seed} {name}.png")
        if arguments.pictures:
            picture(None, filmed, arguments.pictures / f"{seed} truth.png")
            beside(arguments.pictures, seed)
        tell(f"seed {seed}", rows)
        for name, found in looks[str(seed)].items():
            tell_turned(name, found)
        seeds[str(seed)] = rows
        means = {
            name: {k: statistics.fmean(s[name][k] for s in seeds.values()) for k in rows[name]}
            for name in VARIANTS
        }
        write_figures(arguments.json, arguments, seeds=seeds, means=means, turned=looks)
    tell("means", means)


if __name__ == "__main__":
    main()
