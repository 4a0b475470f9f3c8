"""What looking for first colours costs a training step, early and late in a run.

    python benchmarks/speed/first_colors.py --size 256 --uv 128

An avatar learns a procedural film. At some steps two copies of it part ways, one that goes on
looking and one that looks for none, and take the same steps in turn, so that the machine's noise
meets both. Told is the median over the pairs, and how many Gaussians wait for their colour.
"""

import argparse
import copy
import statistics
import time

import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, TrainingStep
from rgbavatar_ns.data import OfflineOrder
from rgbavatar_ns.synthetic import DemoConfig, film_demo

_BATCH_SIZE, _FRAMES, _SEED = 10, 80, 0


def _steps_of(avatar: Avatar, looks: bool) -> TrainingStep:
    options = TrainingOptions(
        seed=_SEED, surface_prior=False, first_colors="matted" if looks else None
    )
    return TrainingStep(copy.deepcopy(avatar), options=options)


def _compared(avatar: Avatar, batches: list[TrainingBatch], pairs: int) -> tuple[float, float]:
    """Milliseconds of a step that looks for none, and the ratio of the other's to it."""
    ways = {looks: _steps_of(avatar, looks) for looks in (False, True)}
    seconds: dict[bool, list[float]] = {False: [], True: []}
    for pair in range(pairs):
        for looks in (False, True) if pair % 2 else (True, False):
            started = time.perf_counter()
            ways[looks](batches[pair % len(batches)], 1 + pair)
            seconds[looks].append(time.perf_counter() - started)
    ratios = [b / a for a, b in zip(seconds[False], seconds[True])]
    return 1e3 * statistics.median(seconds[False]), statistics.median(ratios)


def main() -> None:
    """Train, part ways at times, and print what the look costs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, default=256, help="pixels of the pictures")
    parser.add_argument("--uv", type=int, default=128, help="root of the number of Gaussians")
    parser.add_argument("--steps", type=int, nargs="+", default=[20, 200, 600])
    parser.add_argument("--pairs", type=int, default=60)
    given = parser.parse_args()
    film = film_demo(DemoConfig(image_size=given.size, num_frames=_FRAMES, num_test_frames=0))
    images = torch.stack([torch.from_numpy(frame.image_rgba) for frame in film.frames()])
    order = OfflineOrder(range(_FRAMES), _BATCH_SIZE, _SEED)
    chosen = [list(order.batch(step)) for step in range(_FRAMES)]
    batches = [TrainingBatch(film.tracked[rows], film.camera, images[rows]) for rows in chosen]
    config = AvatarConfig(uv_resolution=given.uv, scale_from_texel_spacing=given.uv < 256)
    avatar = Avatar(film.person.head, film.person.identity, config, seed=_SEED)
    take, taken = TrainingStep(avatar, options=TrainingOptions(seed=_SEED)), 0
    for steps in sorted(given.steps):
        for step in range(taken, steps):
            take(batches[step % len(batches)], step)
        taken = steps
        waiting, count = int((~avatar.color_initialized).sum()), avatar.num_gaussians
        plain, ratio = _compared(avatar, batches, given.pairs)
        print(
            f"after {steps} steps, {waiting} of {count} wait: {plain:.1f} ms, {ratio - 1:+.1%}",
            flush=True,
        )


if __name__ == "__main__":
    main()
