"""How good an avatar is after so many seconds, by the batch size: curves and time to quality.

    python benchmarks/quality/time_to_quality.py --batches 10 5 4 3 --seconds 24 --seeds 0 1 2
    python benchmarks/quality/time_to_quality.py --batches 10 4 --seconds 60 --size-px 512 --uv 256

Procedural films; PSNR of frames held out. Seconds are those of the processor, of one thread, in
steps alone, so that what else runs changes little. Learning rates fall to a tenth over the time.
`4-10:20` takes batches of four for 20 seconds and of ten from then on. Time to quality is when the
curve is within .5 dB of the first batch size's end.
"""

import argparse
import json
import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.metrics import evaluate_images
from rgbavatar_ns.avatar.training import (
    TrainingBatch,
    TrainingOptions,
    TrainingStep,
    make_optimizer,
)
from rgbavatar_ns.data import OfflineOrder
from rgbavatar_ns.synthetic import DemoConfig, film_demo

_MARKS_S = (1, 2, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192)
_FRAMES, _HELD_OUT = 160, 16
_RATES_END, _WITHIN_DB = 0.1, 0.5


@dataclass(frozen=True)
class Batches:
    """Images a step: `first` for some seconds, then `then`."""

    name: str
    first: int
    until_s: float
    then: int

    @classmethod
    def parsed(cls, text: str) -> "Batches":
        """`10`, or `4-10:20`."""
        sizes, _, seconds = text.partition(":")
        first, _, then = sizes.partition("-")
        most = _FRAMES - _HELD_OUT
        try:
            parsed = cls(text, int(first), float(seconds or 0), int(then or first))
        except ValueError as error:
            wrong = f"{text!r} is neither like 10 nor like 4-10:20"
            raise argparse.ArgumentTypeError(wrong) from error
        if not (1 <= parsed.first <= most and 1 <= parsed.then <= most):
            raise argparse.ArgumentTypeError(f"{text!r}: a step takes 1 to {most} images")
        return parsed


class Subject:
    """A procedural person's film, some of its frames held out."""

    def __init__(self, seed: int, size_px: int) -> None:
        self.film = film_demo(
            DemoConfig(image_size=size_px, num_frames=_FRAMES, num_test_frames=_HELD_OUT, seed=seed)
        )
        self.images = torch.stack([torch.from_numpy(f.image_rgba) for f in self.film.frames()])
        self.train = range(_FRAMES - _HELD_OUT)

    def batch(self, rows: list[int]) -> TrainingBatch:
        """Frames as a step takes them."""
        return TrainingBatch(self.film.tracked[rows], self.film.camera, self.images[rows])

    @torch.no_grad()
    def held_out_psnr(self, avatar: Avatar) -> float:
        """Mean over the held-out frames, dB."""
        scores = []
        for row in range(len(self.train), _FRAMES):
            drawn = avatar.render(self.film.tracked[[row]], self.film.camera).image
            scores.append(evaluate_images(drawn, self.images[[row]])["psnr"])
        return statistics.mean(scores)


def curve(
    subject: Subject, batches: Batches, seconds: float, uv: int, progress: Progress
) -> dict[float, float]:
    """Held-out PSNR by seconds of training."""
    film = subject.film
    config = AvatarConfig(uv_resolution=uv, scale_from_texel_spacing=uv < 256)
    avatar = Avatar(film.person.head, film.person.identity, config, seed=0)
    optimizer = make_optimizer(avatar)
    rates = [group["lr"] for group in optimizer.param_groups]
    take = TrainingStep(avatar, [optimizer], TrainingOptions(seed=0))
    orders = {n: OfflineOrder(subject.train, n, 0) for n in (batches.first, batches.then)}
    marks = [mark for mark in _MARKS_S if mark < seconds]
    found: dict[float, float] = {}
    spent, step = 0.0, 0
    bar = progress.add_task(f"batches of {batches.name}", total=seconds)
    while spent < seconds:
        size = batches.first if spent < batches.until_s else batches.then
        batch = subject.batch(list(orders[size].batch(step)))
        for group, rate in zip(optimizer.param_groups, rates):
            group["lr"] = rate * _RATES_END ** (spent / seconds)
        begun = time.process_time()
        take(batch, step)
        spent, step = spent + time.process_time() - begun, step + 1
        progress.update(bar, completed=spent)
        if marks and spent >= marks[0]:
            found[marks.pop(0)] = subject.held_out_psnr(avatar)
    progress.remove_task(bar)
    return found | {seconds: subject.held_out_psnr(avatar)}


def seconds_to(wanted_db: float, curve_db: dict[float, float]) -> float | None:
    """When a curve reaches so much, between its points along straight lines; None: it does not."""
    before = None
    for second, value in sorted(curve_db.items()):
        if value >= wanted_db:
            if before is None:
                return second
            second_before, value_before = before
            part = (wanted_db - value_before) / (value - value_before)
            return second_before + part * (second - second_before)
        before = second, value
    return None


def main() -> None:
    """Train each way on each film, and print the means."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    ten, four = Batches.parsed("10"), Batches.parsed("4")
    parser.add_argument("--batches", type=Batches.parsed, nargs="+", default=[ten, four])
    parser.add_argument("--seconds", type=float, default=24.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--size-px", type=int, default=256)
    parser.add_argument("--uv", type=int, default=128, help="root of the number of Gaussians")
    parser.add_argument("--json", type=Path, help="file for the curves, written as they come")
    given = parser.parse_args()
    torch.set_num_threads(1)
    curves: dict[str, list[dict[float, float]]] = {each.name: [] for each in given.batches}
    with Progress() as progress:
        for seed in given.seeds:
            subject = Subject(seed, given.size_px)
            for each in given.batches:
                found = curve(subject, each, given.seconds, given.uv, progress)
                curves[each.name].append(found)
                if given.json:
                    given.json.write_text(json.dumps(curves, indent=1))
    means = {
        name: {second: statistics.mean(one[second] for one in of) for second in of[0]}
        for name, of in curves.items()
    }
    first = next(iter(means.values()))
    wanted = first[given.seconds] - _WITHIN_DB
    marks = sorted(first)
    table = Table("batch", *(f"{mark:g} s" for mark in marks), f"to {wanted:.1f} dB")
    for name, mean in means.items():
        reached = seconds_to(wanted, mean)
        ends = "not reached" if reached is None else f"{reached:.1f} s"
        table.add_row(name, *(f"{mean[mark]:.2f}" for mark in marks), ends)
    Console().print(table)


if __name__ == "__main__":
    main()
