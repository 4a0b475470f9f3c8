"""What bases and colour initialisation are worth on the demo subject, over several seeds.

    python benchmarks/demo_subject.py --seeds 0 1 2 --json demo_subject.json

For each seed (of the subject and of the training) it prints the held-out PSNR with K = 20 and with
K = 0 after the same steps, and how many steps colour initialisation needs to reach the loss that
training without it has at step 200 (means over ten steps; both runs see the same frames and
backgrounds).
"""

import argparse
import json
import platform
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.progress import Progress

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.losses import composite, rgba_to_float
from rgbavatar_ns.avatar.metrics import psnr
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, fit
from rgbavatar_ns.data import OfflineOrder, TrackedDataset
from rgbavatar_ns.data.demo import DemoConfig, make_demo_dataset
from rgbavatar_ns.head import HeadModel

BATCH_SIZE = 10
WINDOW = 10


class Bench:
    """One demo subject in memory, and runs of training over it."""

    def __init__(self, dataset: TrackedDataset, seed: int, progress: Progress) -> None:
        self.dataset, self.seed, self.progress = dataset, seed, progress
        self.images = torch.stack([self._image(i) for i in range(len(dataset.theta))])
        self.order = OfflineOrder(dataset.train, BATCH_SIZE, seed)

    def _image(self, position: int) -> torch.Tensor:
        return torch.as_tensor(self.dataset.read_image(position))

    def batch(self, step: int) -> TrainingBatch:
        """The frames of a step, the same for every variant."""
        chosen = self.order.batch(step)
        cameras = self.dataset.cameras.select(chosen)
        return TrainingBatch(self.dataset.theta[chosen], cameras, self.images[chosen])

    def train(
        self, title: str, config: AvatarConfig, steps: int, options: TrainingOptions
    ) -> tuple[Avatar, torch.Tensor, float]:
        """Return the trained avatar, each step's loss, and the seconds it took."""
        head = HeadModel(self.dataset.arrays)
        avatar = Avatar(head, self.dataset.identity, config, seed=self.seed)
        bar = self.progress.add_task(f"seed {self.seed}: {title}", total=steps)
        started = time.monotonic()
        losses = fit(
            avatar,
            self.batch,
            steps,
            options,
            on_step=lambda step, loss: self.progress.update(bar, completed=step + 1),
        )
        return avatar, losses, time.monotonic() - started

    @torch.no_grad()
    def held_out_psnr(self, avatar: Avatar) -> float:
        """Mean PSNR in dB over the held-out frames: full frame, black background."""
        scores = []
        for position in self.dataset.test:
            camera = self.dataset.cameras.select([position])
            image = avatar.render(self.dataset.theta[[position]], camera).image
            target = composite(rgba_to_float(self.images[[position]]), torch.zeros(1, 3))
            scores.append(float(psnr(image, target)))
        return statistics.fmean(scores)


def steps_to_reach(losses: torch.Tensor, level: float) -> int | None:
    """The first step whose window's mean loss is at most `level`; None if there is none."""
    means = losses.unfold(0, WINDOW, 1).mean(1)
    below = torch.nonzero(means <= level)
    return int(below[0]) + WINDOW if len(below) else None


def measure(bench: Bench, steps: int, uv_resolution: int) -> dict[str, Any]:
    """Train the variants of one seed and return its figures."""
    config = AvatarConfig(uv_resolution=uv_resolution, scale_from_texel_spacing=True)
    options = TrainingOptions(seed=bench.seed)
    grey = replace(options, color_init=None)
    full, losses, seconds = bench.train("K = 20", config, steps, options)
    base, _, _ = bench.train("K = 0", replace(config, num_bases=0), steps, options)
    _, losses_grey, _ = bench.train("no colour initialisation", config, 200, grey)
    level = float(losses_grey[-WINDOW:].mean())
    with_bases, without = bench.held_out_psnr(full), bench.held_out_psnr(base)
    return {
        "seed": bench.seed,
        "psnr": with_bases,
        "psnr_no_bases": without,
        "gain_of_bases_db": with_bases - without,
        "color_init_steps_to_loss_200": steps_to_reach(losses, level),
        "images_per_second": steps * BATCH_SIZE / seconds,
    }


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
            bench = Bench(dataset, seed, progress)
            rows.append(measure(bench, arguments.steps, arguments.uv_resolution))
        print("  ".join(f"{k} {v:.2f}" if v is not None else f"{k} -" for k, v in rows[-1].items()))
    machine = {"processor": platform.processor() or platform.machine(), "torch": torch.__version__}
    machine |= {"threads": str(torch.get_num_threads()), "python": platform.python_version()}
    medians = {k: statistics.median(row[k] for row in rows) for k in rows[0] if k != "seed"}
    print("medians:  " + "  ".join(f"{k} {v:.2f}" for k, v in medians.items()))
    if arguments.json:
        content = {"settings": vars(arguments) | {"json": None}, "machine": machine}
        arguments.json.write_text(
            json.dumps(content | {"rows": rows, "medians": medians}, indent=2)
        )


if __name__ == "__main__":
    main()
