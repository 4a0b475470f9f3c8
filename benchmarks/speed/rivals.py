"""What a step of each rival costs beside RGBAvatar's eager step with about as many Gaussians.

    python benchmarks/speed/rivals.py --size 256 --steps 10

Both learn the same procedural film on one image a step and take turns, on one thread; what counts
is the processor's time, the median over the turns. The first three steps of each are not counted.
With --all-harmonics methods whose colours follow the view show all degrees at once, as they do from
some thousand steps on.
"""

import argparse
import statistics
import time
from dataclasses import replace
from typing import Any

import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.loading import METHODS
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, TrainingStep
from rgbavatar_ns.avatar.training.freed_memory import keep_freed_memory
from rgbavatar_ns.avatar.training.method_step import MethodStep
from rgbavatar_ns.head import uv_anchors
from rgbavatar_ns.synthetic import DemoConfig, film_demo

_WARM_UP, _FRAMES = 3, 16
_EAGER = TrainingOptions(fast=False, surface_prior=False, first_colors=None)


def _resolution_of(count: int, head: Any) -> int:
    """Side of the UV map that has about as many covered texels."""
    covered = len(uv_anchors(head.uv, head.uv_faces, 64).triangle_index) / 64**2
    return max(1, round((count / covered) ** 0.5))


def main() -> None:
    """Step by turns and print a row for each method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, default=256, help="pixels of the pictures")
    parser.add_argument("--steps", type=int, default=10)
    rivals = [name for name in METHODS if name != Avatar.method]
    parser.add_argument("--methods", nargs="+", choices=rivals, default=rivals)
    parser.add_argument("--all-harmonics", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as ns-train does
    film = film_demo(DemoConfig(image_size=given.size, num_frames=_FRAMES, num_test_frames=0))
    head, identity = film.person.head, film.person.identity
    batches = [
        TrainingBatch(film.tracked[[row]], film.camera, torch.from_numpy(frame.image_rgba)[None])
        for row, frame in enumerate(film.frames())
    ]
    print("| method | Gaussians | ms | RGBAvatar's | Gaussians | ratio |")
    for name in given.methods:
        kind: Any = METHODS[name]
        config = kind.config_type()
        if given.all_harmonics and hasattr(config, "raise_degree_every"):
            config = replace(config, raise_degree_every=1)
        rival = kind(head, identity, config)
        resolution = _resolution_of(rival.num_gaussians, head)
        own_config = AvatarConfig(uv_resolution=resolution, scale_from_texel_spacing=True)
        avatar = Avatar(head, identity, own_config)
        taken: list[tuple[Any, list[float]]] = [
            (MethodStep(rival), []),
            (TrainingStep(avatar, options=_EAGER), []),
        ]
        for step in range(_WARM_UP + given.steps):
            for take, milliseconds in taken:
                started = time.process_time()
                take(batches[step % _FRAMES], step)
                milliseconds.append(1e3 * (time.process_time() - started))
        own, eager = (statistics.median(spent[_WARM_UP:]) for _, spent in taken)
        print(
            f"| {name} | {rival.num_gaussians:,} | {own:.0f} | {eager:.0f} | "
            f"{avatar.num_gaussians:,} | {own / eager:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
