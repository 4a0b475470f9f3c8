"""What each part of the method is worth on the demo subject, over several seeds.

    python benchmarks/quality/demo_subject.py --seeds 0 1 2 --steps 600 --json demo_subject.json

For each seed (of the subject and of the training) it prints the held-out PSNR with K = 20, with
K = 0 and without pose input after the same steps; how many steps colour initialisation needs to
reach the loss that training without it has at step 200 (means over ten steps; both runs see the
same frames and backgrounds); and, with the frames streamed in order, the PSNR over all frames that
were streamed, with local and global pool and with the local pool alone.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.progress import Progress
from subject import BATCH_SIZE, Subject, write_figures

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.training import (
    LossCurve,
    TrainingBatch,
    TrainingOptions,
    TrainingStep,
    fit,
)
from rgbavatar_ns.data import LocalGlobalPools
from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset

WINDOW = 10
LOCAL_SIZE, GLOBAL_SIZE = 15, 100
"""Pools as large a part of 180 training frames as the paper's 150 and 1,000 of a two-minute clip
are of its 3,000, but for the global one, which would hold only the first 60."""


class Bench:
    """Runs of training over one demo subject."""

    def __init__(self, subject: Subject, progress: Progress) -> None:
        self.subject, self.progress = subject, progress

    def train(
        self,
        title: str,
        config: AvatarConfig,
        steps: int,
        color_init: bool = True,
        frames_of: Callable[[int], Sequence[int]] | None = None,
    ) -> tuple[Avatar, torch.Tensor, float]:
        """Return the trained avatar, each step's loss, and the seconds it took.

        `frames_of(step)` gives the frames of a step; by default the offline order.
        """
        chosen = frames_of or self.subject.offline().batch
        options = TrainingOptions(seed=self.subject.seed)
        if not color_init:
            options = replace(options, first_colors=None)
        avatar = self.subject.avatar(config)
        bar = self.progress.add_task(f"seed {self.subject.seed}: {title}", total=steps)

        def batch(step: int) -> TrainingBatch:
            self.progress.update(bar, completed=step + 1)
            return self.subject.batch(chosen(step))

        started, curve = time.monotonic(), LossCurve(steps)
        fit(TrainingStep(avatar, options=options), batch, range(steps), curve)
        return avatar, curve.losses, time.monotonic() - started

    def stream(self, title: str, config: AvatarConfig, steps: int, global_size: int) -> float:
        """Train while the frames arrive evenly and in order; return the PSNR over them all."""
        train = self.subject.dataset.train
        pools = LocalGlobalPools(LOCAL_SIZE, global_size, seed=self.subject.seed)
        waiting, count = list(train), len(train)

        def frames_of(step: int) -> list[int]:
            while waiting and count - len(waiting) <= step * count // steps:
                pools.add(waiting.pop(0))
            return pools.batch(BATCH_SIZE)

        avatar, _, _ = self.train(title, config, steps, frames_of=frames_of)
        return self.subject.psnr(avatar, train)


def steps_to_reach(losses: torch.Tensor, level: float) -> int | None:
    """The first step whose window's mean loss is at most `level`; None if there is none."""
    means = losses.unfold(0, WINDOW, 1).mean(1)
    below = torch.nonzero(means <= level)
    return int(below[0]) + WINDOW if len(below) else None


def measure(bench: Bench, steps: int, uv_resolution: int) -> dict[str, Any]:
    """Train the variants of one seed and return its figures."""
    config = AvatarConfig(uv_resolution=uv_resolution, scale_from_texel_spacing=True)
    test, psnr = bench.subject.dataset.test, bench.subject.psnr
    full, losses, seconds = bench.train("K = 20", config, steps)
    base, _, _ = bench.train("K = 0", replace(config, num_bases=0), steps)
    no_pose, _, _ = bench.train("no pose input", replace(config, pose_input=False), steps)
    _, losses_grey, _ = bench.train("no colour initialisation", config, 200, color_init=False)
    return {
        "seed": bench.subject.seed,
        "psnr": psnr(full, test),
        "psnr_no_bases": psnr(base, test),
        "psnr_no_pose_input": psnr(no_pose, test),
        "color_init_steps_to_loss_200": steps_to_reach(losses, float(losses_grey[-WINDOW:].mean())),
        "streamed_psnr": bench.stream("streamed", config, steps, GLOBAL_SIZE),
        "streamed_psnr_no_global": bench.stream("streamed, no global pool", config, steps, 0),
        "images_per_second": steps * BATCH_SIZE / seconds,
    }


def row_text(row: dict[str, Any]) -> str:
    """One line of figures."""
    cells = (
        f"{key} {value:.2f}" if value is not None else f"{key} -" for key, value in row.items()
    )
    return "  ".join(cells)


def main() -> None:
    """Run all seeds and print one row each, then the medians."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--uv-resolution", type=int, default=128)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    rows = []
    for seed in arguments.seeds:
        with tempfile.TemporaryDirectory() as folder, Progress() as progress:
            progress.add_task(f"seed {seed}: subject", total=None)
            dataset = make_demo_dataset(Path(folder) / "subject", DemoConfig(seed=seed))
            bench = Bench(Subject.of(dataset, seed), progress)
            rows.append(measure(bench, arguments.steps, arguments.uv_resolution))
        print(row_text(rows[-1]), flush=True)
    keys = [key for key in rows[0] if key != "seed" and all(row[key] is not None for row in rows)]
    medians = {key: statistics.median(row[key] for row in rows) for key in keys}
    print("medians:  " + row_text(medians))
    write_figures(arguments.json, arguments, rows=rows, medians=medians)


if __name__ == "__main__":
    main()
