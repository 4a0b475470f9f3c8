"""What the two pools are worth: online training on the demo subject, without a clock.

    python benchmarks/quality/online.py --seeds 0 1 2 --out outputs/online
    python benchmarks/quality/online.py --frames 750 --image-size 128 --uv-resolution 64

The frames of a performance at 25 frames/s are streamed in order; between two of them as many steps
are taken as a trainer of `--images-per-second` manages, so that the figures do not depend on how
busy the machine is; then follow `--steps-after-stream` steps on all that the pools hold, while the
rates fall to a tenth, as in `ns-train rgbavatar-online`. Variants: the paper's share (eta = .7),
eta = .3 (the tiny preset's), .1, 0 and 1, without the global and without the local pool, the
release's strategy, new frames first (the default of `ns-train rgbavatar-online`), the paper's whole
way, which has no steps after the stream, and offline training with as many images, with rates that
fall in the same way at its end and with constant ones.

Printed for each, as means over the seeds: held-out PSNR after the stream, PSNR over the streamed
frames, PSNR of the newest second's frames while the stream runs (in its second half), and how much
of each frame was forgotten (its L1 after the stream minus the lowest that it ever had, looked at
twice a second for every tenth frame; looking takes longer than training where streams are long, and
`--looks-per-second .2` spares it), and how many Gaussians the avatar shows with a weight above .1
in any streamed frame though they were never given a first colour. Drawn: loss by frame and PSNR by
time.
"""

import argparse
import math
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from subject import BATCH_SIZE, Subject, write_figures
from torch import Tensor

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.training import TrainingOptions, TrainingStep
from rgbavatar_ns.avatar.training.color_init import WEIGHT_THRESHOLD
from rgbavatar_ns.data import LocalGlobalPools, TrackedDataset, load_dataset
from rgbavatar_ns.kernels import rasterize
from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset

FRAMES_PER_SECOND = 25.0
PAPER_STREAM_FRAMES = 3000
PRESET_STEPS_AFTER = 500
FINAL_RATE = 0.1
LOOKED_AT = 10
NEWEST, NEWEST_EVERY = 25, 4
OFFLINE, OFFLINE_CONSTANT = "offline", "offline, constant rates"
PAPER = "eta .7, no steps after (paper)"


def variants(frames: int, seed: int) -> dict[str, Callable[[], LocalGlobalPools]]:
    """The pools of each variant by its name, as large a part of the stream as the paper's are."""
    part = min(1.0, frames / PAPER_STREAM_FRAMES)
    local, old = (max(BATCH_SIZE, round(size * part)) for size in (150, 1000))
    return {
        "eta .7": lambda: LocalGlobalPools(local, old, 0.7, seed),
        "eta .1": lambda: LocalGlobalPools(local, old, 0.1, seed),
        "eta .3": lambda: LocalGlobalPools(local, old, 0.3, seed),
        "eta .3, new first": lambda: LocalGlobalPools(local, old, 0.3, seed, new_first=True),
        PAPER: lambda: LocalGlobalPools(local, old, 0.7, seed),
        "eta .7, new first": lambda: LocalGlobalPools(local, old, 0.7, seed, new_first=True),
        "eta 0": lambda: LocalGlobalPools(local, old, 0.0, seed),
        "eta 1": lambda: LocalGlobalPools(local, old, 1.0, seed),
        "w/o global": lambda: LocalGlobalPools(local, 0, 1.0, seed),
        # One frame passes through on its way to the global pool.
        "w/o local": lambda: LocalGlobalPools(1, old, 0.0, seed),
        "release": lambda: LocalGlobalPools(local, old, None, seed, "release"),
    }


@dataclass
class Outcome:
    """One run's figures; losses by the position of the frames looked at."""

    test_psnr: float = 0.0
    streamed_psnr: float = 0.0
    newest: list[float] = field(default_factory=list)
    loss_after: list[float] = field(default_factory=list)
    loss_lowest: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)
    train_seconds: float = 0.0
    visible: int = 0
    colorless: int = 0

    @property
    def newest_psnr(self) -> float:
        """Mean over the stream's second half of what the newest second looked like."""
        return statistics.fmean(self.newest[len(self.newest) // 2 :] or [math.nan])

    @property
    def forgotten(self) -> float:
        """Mean L1 after the stream beyond the lowest."""
        pairs = zip(self.loss_after, self.loss_lowest)
        return statistics.fmean(after - lowest for after, lowest in pairs)


class Bench:
    """Runs of training over a subject; `arguments` are the command's."""

    def __init__(self, subject: Subject, arguments: argparse.Namespace) -> None:
        self.subject, self.dataset = subject, subject.dataset
        self.steps_after = steps_after(arguments)
        self.frames_per_look = max(1, round(FRAMES_PER_SECOND / arguments.looks_per_second))
        self.config = AvatarConfig(
            uv_resolution=arguments.uv_resolution, scale_from_texel_spacing=True
        )
        self.steps_per_frame = arguments.images_per_second / FRAMES_PER_SECOND / BATCH_SIZE
        self.looked_at = self.dataset.train[::LOOKED_AT]
        self.scored = self.dataset.test[:: max(1, len(self.dataset.test) // 30)]

    def train(
        self,
        pools: LocalGlobalPools | None,
        advance: Callable[[], object],
        steps_after: int,
        final_rate: float,
    ) -> Outcome:
        """Stream all training frames through the pools; offline without pools."""
        avatar, offline = self.subject.avatar(self.config), self.subject.offline()
        take = TrainingStep(avatar, options=TrainingOptions(seed=self.subject.seed))
        outcome, lowest, step = Outcome(), dict.fromkeys(self.looked_at, math.inf), 0
        for arrived, position in enumerate(self.dataset.train, start=1):
            if pools is not None:
                pools.add(position)
            began = time.monotonic()
            while step < arrived * self.steps_per_frame:
                chosen = offline.batch(step) if pools is None else pools.batch(BATCH_SIZE)
                take(self.subject.batch(chosen), step)
                step += 1
            outcome.train_seconds += time.monotonic() - began
            if arrived % self.frames_per_look == 0:
                seen = [p for p in self.looked_at if p < position or pools is None]
                for place, loss in self.losses(avatar, seen).items():
                    lowest[place] = min(lowest[place], loss)
                outcome.seconds.append(arrived / FRAMES_PER_SECOND)
                outcome.psnr.append(self.subject.psnr(avatar, self.scored))
                newest = self.dataset.train[max(0, arrived - NEWEST) : arrived : NEWEST_EVERY]
                outcome.newest.append(self.subject.psnr(avatar, newest))
            advance()
        began = time.monotonic()
        for _ in range(steps_after):
            evenly = None if pools is None else pools.batch(BATCH_SIZE, evenly=True)
            take(self.subject.batch(evenly or offline.batch(step)), step)
            for group in take.optimizers[0].param_groups:
                group["lr"] *= final_rate ** (1 / steps_after)
            step += 1
        held = [] if pools is None else sorted([*pools.local_frames, *pools.global_frames])
        parts = range(0, len(held), BATCH_SIZE)
        take.look_back(self.subject.batch(held[k : k + BATCH_SIZE]) for k in parts)
        outcome.train_seconds += time.monotonic() - began
        after = self.losses(avatar, list(self.looked_at))
        outcome.loss_after = [after[p] for p in self.looked_at]
        outcome.loss_lowest = [min(lowest[p], after[p]) for p in self.looked_at]
        outcome.test_psnr = self.subject.psnr(avatar, self.dataset.test)
        outcome.streamed_psnr = self.subject.psnr(avatar, self.looked_at)
        visible = self.visible(avatar)
        outcome.visible = int(visible.sum())
        outcome.colorless = int((visible & ~avatar.color_initialized).sum())
        return outcome

    @torch.no_grad()
    def visible(self, avatar: Avatar) -> Tensor:
        """Which Gaussians the avatar, as it is now, shows well in any streamed frame."""
        found = torch.zeros(avatar.num_gaussians, dtype=torch.bool)
        for start in range(0, len(self.dataset.train), BATCH_SIZE):
            chosen = list(self.dataset.train[start : start + BATCH_SIZE])
            cameras = self.dataset.cameras.select(chosen)
            drawn = rasterize(
                avatar.gaussians(self.dataset.theta[chosen]), cameras, with_visibility=True
            )
            assert drawn.visibility is not None
            found |= (drawn.visibility > WEIGHT_THRESHOLD).any(0)
        return found

    def losses(self, avatar: Avatar, positions: list[int]) -> dict[int, float]:
        """L1 of each frame."""
        found: dict[int, float] = {}
        for start in range(0, len(positions), BATCH_SIZE):
            chosen = positions[start : start + BATCH_SIZE]
            image, target = self.subject.shown(avatar, chosen)
            errors = (image - target).abs().mean(dim=(1, 2, 3))
            found |= dict(zip(chosen, errors.tolist()))
        return found


def film(seed: int, arguments: argparse.Namespace, folder: Path) -> TrackedDataset:
    """The demo subject of a seed, made once where `--subjects` names a folder."""
    config = DemoConfig(
        image_size=arguments.image_size,
        num_frames=arguments.frames + arguments.test_frames,
        num_test_frames=arguments.test_frames,
        seed=seed,
        frames_per_second=FRAMES_PER_SECOND,
    )
    place = (arguments.subjects or folder) / f"{config.image_size}_{config.num_frames}_{seed}"
    if (place / "dataset.json").exists():
        return load_dataset(place)
    with Progress() as progress:
        bar = progress.add_task(f"seed {seed}: subject", total=config.num_frames)
        return make_demo_dataset(
            place, config, lambda done, total: progress.update(bar, completed=done)
        )


def steps_after(arguments: argparse.Namespace) -> int:
    """As many of the preset's steps after the stream as the stream is of two minutes."""
    if arguments.steps_after_stream is not None:
        return arguments.steps_after_stream
    return round(PRESET_STEPS_AFTER * min(1.0, arguments.frames / PAPER_STREAM_FRAMES))


def measure(seed: int, arguments: argparse.Namespace, folder: Path) -> dict[str, Outcome]:
    """Every variant's outcome for one seed."""
    bench = Bench(Subject.of(film(seed, arguments, folder), seed), arguments)
    frames = len(bench.dataset.train)
    outcomes: dict[str, Outcome] = {}
    with Progress() as progress:
        alone = dict.fromkeys([OFFLINE, OFFLINE_CONSTANT], lambda: None)
        for name, make in {**variants(frames, seed), **alone}.items():
            if arguments.variants and name not in arguments.variants:
                continue
            bar = progress.add_task(f"seed {seed}: {name}", total=frames)
            outcomes[name] = one = bench.train(
                make(),
                lambda bar=bar: progress.advance(bar),
                0 if name == PAPER else bench.steps_after,
                1.0 if name == OFFLINE_CONSTANT else FINAL_RATE,
            )
            progress.console.print(
                f"seed {seed}, {name}: held-out {one.test_psnr:.2f} dB, streamed "
                f"{one.streamed_psnr:.2f} dB, newest {one.newest_psnr:.2f} dB, "
                f"forgotten {one.forgotten:.5f}, {one.colorless} of {one.visible} Gaussians "
                "without a first colour",
                highlight=False,
            )
    return outcomes


def table(runs: list[dict[str, Outcome]], images: int) -> Table:
    """Means over the seeds, and the spread of the held-out PSNR."""
    drawn = Table(title=f"{len(runs)} seeds, {images} images a run")
    columns = (
        "variant",
        "held-out PSNR",
        "by seed",
        "streamed PSNR",
        "newest PSNR",
        "forgotten L1",
        "without colour",
    )
    for column in columns:
        drawn.add_column(column)
    for name in runs[0]:
        mine = [run[name] for run in runs]
        drawn.add_row(
            name,
            f"{statistics.fmean(one.test_psnr for one in mine):.2f}",
            " ".join(f"{one.test_psnr:.2f}" for one in mine),
            f"{statistics.fmean(one.streamed_psnr for one in mine):.2f}",
            f"{statistics.fmean(one.newest_psnr for one in mine):.2f}",
            f"{statistics.fmean(one.forgotten for one in mine):.5f}",
            " ".join(str(one.colorless) for one in mine),
        )
    return drawn


def draw(outcomes: dict[str, Outcome], out: Path) -> None:
    """The first seed's losses by frame (paper, forgetting figure) and PSNR by stream time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        2, math.ceil(len(outcomes) / 2), figsize=(16, 7), sharex=True, sharey=True, squeeze=False
    )
    for axis, (name, one) in zip(axes.flat, outcomes.items()):
        frames = [LOOKED_AT * i for i in range(len(one.loss_after))]
        axis.plot(frames, one.loss_after, label="after the stream", linewidth=1)
        axis.plot(frames, one.loss_lowest, label="lowest it ever had", linewidth=1)
        axis.set_title(f"{name}: forgotten {one.forgotten:.5f}", fontsize=10)
        axis.set_xlabel("frame")
        axis.set_ylabel("L1")
    axes.flat[0].legend()
    figure.tight_layout()
    figure.savefig(out / "forgetting.png", dpi=90)
    figure, axis = pyplot.subplots(figsize=(9, 6))
    for name, one in outcomes.items():
        axis.plot(one.seconds, one.psnr, label=name, linewidth=1.3)
    axis.set_xlabel("stream time in seconds")
    axis.set_ylabel("PSNR of held-out frames in dB")
    axis.legend()
    figure.tight_layout()
    figure.savefig(out / "psnr_by_time.png", dpi=90)


def report(runs: list[dict[str, Outcome]], arguments: argparse.Namespace) -> None:
    """Print the table, write figures and drawings."""
    images = math.ceil(arguments.frames * arguments.images_per_second / FRAMES_PER_SECOND)
    images += BATCH_SIZE * steps_after(arguments)
    Console(width=110).print(table(runs, images))
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(runs[0], arguments.out)
    figures = [{name: vars(one) for name, one in run.items()} for run in runs]
    write_figures(arguments.out / "online.json", arguments, runs=figures)


def main() -> None:
    """Run all seeds; what is done is reported after each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--frames", type=int, default=PAPER_STREAM_FRAMES)
    parser.add_argument("--test-frames", type=int, default=350)
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--uv-resolution", type=int, default=128)
    parser.add_argument("--images-per-second", type=float, default=200.0)
    parser.add_argument("--steps-after-stream", type=int, help="500 for 3,000 frames")
    parser.add_argument("--looks-per-second", type=float, default=2.0)
    names = [*variants(PAPER_STREAM_FRAMES, 0), OFFLINE, OFFLINE_CONSTANT]
    parser.add_argument("--variants", nargs="+", choices=names, help="only these, by their names")
    parser.add_argument("--subjects", type=Path, help="keep the subjects here")
    parser.add_argument("--out", type=Path, default=Path("outputs/online"))
    arguments = parser.parse_args()
    runs: list[dict[str, Outcome]] = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in arguments.seeds:
            runs.append(measure(seed, arguments, Path(folder)))
            report(runs, arguments)


if __name__ == "__main__":
    main()
