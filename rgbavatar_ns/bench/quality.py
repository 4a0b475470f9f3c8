"""`rgbavatar bench quality`: how good an avatar is after so many seconds of training."""

import math
import statistics
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Column, Table
from torch.utils import benchmark

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.metrics import evaluate_images
from rgbavatar_ns.avatar.training import (
    TrainingBatch,
    TrainingOptions,
    TrainingStep,
    make_optimizer,
)
from rgbavatar_ns.bench.machine import chosen_device, machine_facts, require_backend
from rgbavatar_ns.bench.options import Batches, QualityOptions
from rgbavatar_ns.bench.scenes import on_device
from rgbavatar_ns.bench.timing import CPU, Progress
from rgbavatar_ns.data import ImageCache, OfflineOrder, TrackedDataset, load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import read_json
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset
from rgbavatar_ns.threads import using_threads

_MARKS_S = (1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 96.0, 128.0, 192.0)
_FRAMES, _HELD_OUT, _SIZE_PX = 160, 16, 256
_MOST_SCORED = 32
"""Held-out frames that are drawn for a score, spread over all: a curve has many scores."""
_RATES_END = 0.1
_CACHE_BYTES = 1 << 30
_OWN_TEXELS_BELOW = 256
"""Gaussians of a smaller UV map begin as large as its texels (the preset rgbavatar-tiny)."""

Curve = dict[float, float]
"""PSNR of held-out frames, dB, by seconds of training."""


@dataclass(frozen=True)
class QualityReport:
    """Curves by images a step, one a subject, and what they say."""

    workload: dict[str, Any]
    curves: dict[str, list[Curve]]
    machine: dict[str, Any] = field(default_factory=machine_facts)
    within_db: float = 0.5
    """So near its end a curve counts as good."""

    def means(self) -> dict[str, Curve]:
        """Each way's mean over the subjects; none for one that is still to come."""
        return {name: mean_curve(curves) for name, curves in self.curves.items() if curves}

    def seconds_to_quality(self) -> dict[str, float]:
        """When each mean is so near its own end."""
        found = {}
        for name, mean in self.means().items():
            reached = seconds_to(mean[max(mean)] - self.within_db, mean)
            assert reached is not None
            found[name] = reached
        return found

    def to_json(self) -> dict[str, Any]:
        """The same as plain values."""
        told = {"benchmark": "quality", "seconds_to_quality": self.seconds_to_quality()}
        return told | asdict(self)

    @classmethod
    def read(cls, path: Path) -> "QualityReport | None":
        """What `to_json` wrote; None where there is no such file or it holds something else."""
        told = read_json(path)
        try:
            curves = {
                name: [{float(second): float(psnr) for second, psnr in one.items()} for one in of]
                for name, of in told["curves"].items()
            }
            workload, machine = dict(told["workload"]), dict(told["machine"])
            return cls(workload, curves, machine, float(told["within_db"]))
        except (LookupError, TypeError, ValueError, AttributeError):
            return None

    def is_begun_of(self, workload: dict[str, Any], names: Collection[str]) -> bool:
        """Whether this measures the same and has curves still to come."""
        counts = [len(of) for of in self.curves.values()]
        same = self.workload == workload and self.curves.keys() == set(names)
        return same and min(counts) < len(workload["seeds"])


def bench_quality(
    options: QualityOptions,
    progress: Progress | None = None,
    found: Callable[[QualityReport], None] = lambda report: None,
    begun: QualityReport | None = None,
) -> QualityReport:
    """Train each way on each subject; `found` is told whenever a curve is there.

    What was `begun` with the same options and not finished is gone on with. Raises UserError for
    data that cannot be read, has no frames held out or too few for a step.
    """
    tell = progress or (lambda what, done, total: None)
    device = chosen_device(options.device)
    backend = require_backend("auto", device)
    ways = [Batches.parsed(text) for text in dict.fromkeys(options.batches)]
    curves: dict[str, list[Curve]] = {way.name: [] for way in ways}
    size = _SIZE_PX if options.size is None else options.size
    facts = {
        "data": f"procedural, {size} px" if options.data is None else str(options.data),
        "seeds": list(options.seeds),
        "seconds": options.seconds,
        "uv_resolution": options.uv,
        "device": device.type,
        "backend": backend,
    }
    with using_threads(options.threads) as threads:
        facts["threads"] = threads
        if begun is not None and begun.is_begun_of(facts, curves):
            curves = begun.curves
        for number, seed in enumerate(options.seeds):
            missing = [way for way in ways if len(curves[way.name]) <= number]
            if not missing:
                continue
            with _dataset(options.data, seed, size, tell) as dataset:
                subject = _Subject(dataset, seed, device)
                for way in missing:
                    curves[way.name].append(_curve(subject, way, options, threads, tell))
                    found(QualityReport(facts, curves))
        return QualityReport(facts, curves)  # here, where the threads are those of the curves


@contextmanager
def _dataset(
    path: Path | None, seed: int, size_px: int, tell: Progress
) -> Iterator[TrackedDataset]:
    if path is not None:
        yield load_dataset(path)
        return
    config = DemoConfig(
        image_size=size_px, num_frames=_FRAMES, num_test_frames=_HELD_OUT, seed=seed
    )
    with tempfile.TemporaryDirectory(prefix="rgbavatar-bench-") as folder:
        yield make_demo_dataset(
            Path(folder) / "data",
            config,
            lambda done, total: tell(f"filming person {seed}", done, total),
        )


class _Subject:
    """A dataset to train on and to measure with."""

    def __init__(self, dataset: TrackedDataset, seed: int, device: torch.device) -> None:
        if not dataset.test:
            raise UserError(
                f"No frame of {dataset.root} is held out, so there is nothing to measure on.",
                "Track it with --test-frames, or pass another dataset.",
            )
        self.dataset, self.seed, self.device = dataset, seed, device
        every = max(1, math.ceil(len(dataset.test) / _MOST_SCORED))
        self.scored = dataset.test[::every]
        self._images = ImageCache(dataset, _CACHE_BYTES)

    def avatar(self, uv: int) -> Avatar:
        """A fresh one."""
        config = AvatarConfig(uv_resolution=uv, scale_from_texel_spacing=uv < _OWN_TEXELS_BELOW)
        head = HeadModel(self.dataset.arrays)
        return Avatar(head, self.dataset.identity, config, seed=self.seed).to(self.device)

    def order(self, images: int) -> OfflineOrder:
        """Training frames step by step."""
        if images > len(self.dataset.train):
            raise UserError(
                f"A step of {images} different images cannot be made of the "
                f"{len(self.dataset.train)} that {self.dataset.root} has to train on.",
                "Pass a smaller number to --batches.",
            )
        return OfflineOrder(self.dataset.train, images, self.seed)

    def batch(self, positions: Sequence[int]) -> TrainingBatch:
        """Frames as a step takes them."""
        chosen = list(positions)
        cameras = self.dataset.cameras.select(chosen)
        batch = TrainingBatch(self.dataset.theta[chosen], cameras, self._images.get(chosen))
        return on_device(batch, self.device)

    @torch.no_grad()
    def held_out_psnr(self, avatar: Avatar) -> float:
        """Mean over held-out frames, dB."""
        scores: list[float] = []
        for position in self.scored:
            batch = self.batch([position])
            drawn = avatar.render(batch.theta, batch.cameras).image
            score = evaluate_images(drawn, torch.as_tensor(batch.images_rgba))["psnr"]
            assert isinstance(score, float)
            scores.append(score)
        return statistics.mean(scores)


def _curve(
    subject: _Subject, way: Batches, options: QualityOptions, threads: int, tell: Progress
) -> Curve:
    avatar, seconds = subject.avatar(options.uv), options.seconds
    orders = {size: subject.order(size) for size in (way.first, way.then)}
    optimizer = make_optimizer(avatar)
    rates = [group["lr"] for group in optimizer.param_groups]
    take = TrainingStep(avatar, [optimizer], TrainingOptions(seed=subject.seed))
    by_processor = subject.device == CPU and threads == 1
    clock = time.process_time if by_processor else benchmark.timer
    marks = [mark for mark in _MARKS_S if mark < seconds]
    found: Curve = {}
    spent, step = 0.0, 0
    while spent < seconds:
        tell(f"{way.name} images a step, subject {subject.seed}, s", int(spent), round(seconds))
        size = way.first if spent < way.until_s else way.then
        batch = subject.batch(orders[size].batch(step))
        for group, rate in zip(optimizer.param_groups, rates):
            group["lr"] = rate * _RATES_END ** (spent / seconds)
        begun = clock()
        take(batch, step)
        spent, step = spent + clock() - begun, step + 1
        psnr = subject.held_out_psnr(avatar) if marks and spent >= marks[0] else None
        while psnr is not None and marks and spent >= marks[0]:
            found[marks.pop(0)] = psnr
    return found | {seconds: subject.held_out_psnr(avatar)}


def mean_curve(curves: Sequence[Curve]) -> Curve:
    """At the seconds that all have."""
    return {second: statistics.mean(one[second] for one in curves) for second in curves[0]}


def seconds_to(wanted_db: float, curve: Mapping[float, float]) -> float | None:
    """When a curve reaches so much, between its points along straight lines; None: it does not."""
    before = None
    for second, value in sorted(curve.items()):
        if value >= wanted_db:
            if before is None:
                return second
            second_before, value_before = before
            part = (wanted_db - value_before) / (value - value_before)
            return second_before + part * (second - second_before)
        before = second, value
    return None


def print_quality(report: QualityReport) -> None:
    """Print the mean curves as a table."""
    console = Console(highlight=False)
    console.rule("rgbavatar bench quality")
    for facts in (report.workload, report.machine):
        told = (f"{name} {value}" for name, value in facts.items() if value is not None)
        console.print(", ".join(told))
    means, reached = report.means(), report.seconds_to_quality()
    first = next(iter(means.values()))
    end_db = first[max(first)] - report.within_db
    table = Table("images a step", *(Column(name, justify="right") for name in means))
    for mark in sorted(first):
        table.add_row(f"after {mark:g} s", *(f"{mean[mark]:.2f} dB" for mean in means.values()))
    near = f"within {report.within_db:g} dB of its end after"
    table.add_row(near, *(f"{reached[name]:.1f} s" for name in means), end_section=True)
    to_first = [seconds_to(end_db, mean) for mean in means.values()]
    told = ("not reached" if one is None else f"{one:.1f} s" for one in to_first)
    table.add_row(f"{end_db:.1f} dB (so near the first's) after", *told)
    console.print(table)
    console.print("PSNR of held-out frames, mean of the subjects.")
