"""What the surface prior costs a training step.

    python benchmarks/speed/surface_prior.py --size 256 --uv 128

Two avatars learn the same procedural film, one of them with the prior, by turns of 40 steps, so
that the machine's noise meets both; a step of a third before is not counted. Told are the medians
over the turns, and the measurement before the first step by itself. 600 steps are those of
`benchmarks/quality/beyond.py`.
"""

import argparse
import statistics
import time

import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, TrainingStep
from rgbavatar_ns.data import OfflineOrder
from rgbavatar_ns.synthetic import DemoConfig, film_demo

_TURN = 40
"""Steps between two changes: all that the prior does comes round in so many."""
_BATCH_SIZE, _FRAMES, _SEED = 10, 80, 0


class _Trained:
    """An avatar that learns, and what each of its steps took in seconds."""

    def __init__(self, batches: list[TrainingBatch], fresh: Avatar, surface_prior: bool) -> None:
        options = TrainingOptions(seed=_SEED, surface_prior=surface_prior)
        self._step, self._batches = TrainingStep(fresh, options=options), batches
        self.num_gaussians = fresh.num_gaussians
        self.seconds: list[float] = []

    def go_on(self, steps: int) -> None:
        for _ in range(steps):
            step = len(self.seconds)
            started = time.perf_counter()
            self._step(self._batches[step % len(self._batches)], step)
            self.seconds.append(time.perf_counter() - started)

    def turns(self) -> list[float]:
        """Milliseconds a step, of each turn but the first, which measures the person."""
        ends = range(_TURN, len(self.seconds), _TURN)
        return [1e3 * statistics.fmean(self.seconds[end : end + _TURN]) for end in ends]


def main() -> None:
    """Train by turns and print what a step takes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, default=256, help="pixels of the pictures")
    parser.add_argument("--uv", type=int, default=128, help="root of the number of Gaussians")
    parser.add_argument("--steps", type=int, default=600)
    given = parser.parse_args()
    if given.steps < 2 * _TURN:
        parser.error(f"--steps {given.steps} is less than two turns: give {2 * _TURN} or more.")
    film = film_demo(DemoConfig(image_size=given.size, num_frames=_FRAMES, num_test_frames=0))
    images = torch.stack([torch.from_numpy(frame.image_rgba) for frame in film.frames()])
    order = OfflineOrder(range(_FRAMES), _BATCH_SIZE, _SEED)
    chosen = [list(order.batch(step)) for step in range(_FRAMES)]
    batches = [TrainingBatch(film.tracked[rows], film.camera, images[rows]) for rows in chosen]
    config = AvatarConfig(uv_resolution=given.uv, scale_from_texel_spacing=True)
    uncounted, plain, ours = (
        _Trained(batches, Avatar(film.person.head, film.person.identity, config, seed=_SEED), prior)
        for prior in (False, False, True)
    )
    uncounted.go_on(1)  # what a process's first step takes more is no part of the comparison
    for _ in range(given.steps // _TURN):
        plain.go_on(_TURN)
        ours.go_on(_TURN)
    without, with_it = statistics.median(plain.turns()), statistics.median(ours.turns())
    pairs = [b / a for a, b in zip(plain.turns(), ours.turns())]
    first = ours.seconds[0] - plain.seconds[0]
    whole = sum(ours.seconds) / sum(plain.seconds)
    print(f"{given.size} px, {ours.num_gaussians} Gaussians: a step takes {without:.1f} ms without")
    print(f"the prior, {with_it:.1f} ms with it: {statistics.median(pairs) - 1:+.1%} (median)")
    print(f"the first measurement {first:.2f} s; all {len(ours.seconds)} steps {whole - 1:+.1%}")


if __name__ == "__main__":
    main()
