"""Draw docs/speed.png: the rasterizer's cost against N, B and pixels, and beside its peers.

    python benchmarks/speed/plots.py --json speed.json
    python benchmarks/speed/plots.py --from-json speed.json

The first line measures (a few minutes, on a machine that does nothing else); the second draws
again what was measured. The workload is the ellipsoid of `rgbavatar bench rasterizer`, forward
with backward; what is not varied is N = 60,000, B = 10 and 512 x 512.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.progress import Progress

from rgbavatar_ns.bench.machine import machine_facts
from rgbavatar_ns.bench.options import RasterizerOptions
from rgbavatar_ns.bench.rasterizer import WHOLE, bench_rasterizer, time_rasterizer
from rgbavatar_ns.bench.scenes import DEFAULT_COUNT, DEFAULT_SIZE_PX, ellipsoid_scene
from rgbavatar_ns.bench.timing import Stopwatch
from rgbavatar_ns.errors import UserError, told_without_traceback
from rgbavatar_ns.files import write_json
from rgbavatar_ns.reading import DamagedFileError, load_json
from rgbavatar_ns.threads import using_threads

Points = list[tuple[float, float, float, float]]
"""(what is varied, median, lower and upper quartile in milliseconds)."""


@dataclass
class Options:
    """What to measure and where to draw it."""

    output: Path = Path("docs/speed.png")
    json: Path | None = None
    """Also write the figures here."""
    from_json: Path | None = None
    """Draw these figures and measure nothing."""
    counts: tuple[int, ...] = (7_500, 15_000, 30_000, 60_000, 90_000, 120_000)
    batches: tuple[int, ...] = (1, 2, 5, 10, 15, 20)
    sizes: tuple[int, ...] = (128, 256, 384, 512, 768, 1024)
    repetitions: int = 9
    threads: int | None = None
    peers: bool = True


def measure(options: Options) -> dict[str, Any]:
    """All four panels' figures."""
    with using_threads(options.threads), Progress(auto_refresh=False) as bar:
        counts = _sweep(bar, "N", [(n, DEFAULT_SIZE_PX, 10) for n in options.counts], options)
        batches = _sweep(
            bar, "B", [(DEFAULT_COUNT, DEFAULT_SIZE_PX, b) for b in options.batches], options
        )
        sizes = _sweep(bar, "pixels", [(DEFAULT_COUNT, s, 10) for s in options.sizes], options)
        task = bar.add_task("peers", total=None)
        report = bench_rasterizer(
            RasterizerOptions(repetitions=options.repetitions, peers=options.peers, device="cpu"),
            lambda what, done, total: bar.update(task, description=what, refresh=True),
        )
        return {
            "ms_per_image_by_count": _divided(counts, options.counts, 10),
            "ms_per_batch_by_batch": _divided(batches, options.batches, 1),
            "ms_per_image_by_pixels": _divided(sizes, [s * s for s in options.sizes], 10),
            "rasterizer": report.to_json(),
            "machine": machine_facts(),
        }


def _sweep(
    bar: Progress, title: str, scenes: Sequence[tuple[int, int, int]], options: Options
) -> list[tuple[float, float, float]]:
    """Median and quartiles in milliseconds a batch of (N, side, B)."""
    found = []
    task = bar.add_task(title, total=len(scenes))
    for count, size_px, batch in scenes:
        gaussians, cameras = ellipsoid_scene(count, size_px, batch)
        stopwatch = Stopwatch(options.repetitions)
        whole = time_rasterizer(gaussians, cameras, stopwatch)[0][WHOLE]
        found.append((whole.median_ms, whole.lower_ms, whole.upper_ms))
        bar.update(task, advance=1, refresh=True)
    return found


def _divided(
    spreads: list[tuple[float, float, float]], varied: Sequence[float], images: int
) -> Points:
    return [
        (float(x), median / images, lower / images, upper / images)
        for x, (median, lower, upper) in zip(varied, spreads)
    ]


def draw(figures: dict[str, Any], path: Path) -> None:
    """Write the four panels as a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    style: Any = {"axes.spines.top": False, "axes.spines.right": False, "font.size": 9}
    with plt.rc_context(style):
        figure, axes = plt.subplots(1, 4, figsize=(13, 3.2), layout="constrained")
        _line(
            axes[0], figures["ms_per_image_by_count"], 1e-3, "Gaussians N (thousands)", "an image"
        )
        _line(axes[1], figures["ms_per_batch_by_batch"], 1, "images B in a batch", "a batch")
        _line(axes[2], figures["ms_per_image_by_pixels"], 1e-3, "pixels (thousands)", "an image")
        _bars(axes[3], figures["rasterizer"])
        facts = figures["machine"]
        figure.supxlabel(
            f"forward and backward; {facts['processor']}, {facts['threads']} threads, "
            f"{facts['instruction_set']}, commit {facts['commit']}, {facts['date'][:10]}",
            fontsize=7,
            color="0.4",
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130)
        plt.close(figure)


def _line(axis: Any, points: Points, unit: float, label: str, per: str) -> None:
    """Medians with quartiles, and the straight line that fits them best."""
    x, median, lower, upper = np.asarray(points).T
    slope, offset = np.polyfit(x, median, 1)
    ends = np.array([0.0, x.max()])
    axis.plot(unit * ends, offset + slope * ends, color="0.75", zorder=0)
    axis.errorbar(unit * x, median, [median - lower, upper - median], fmt="o", ms=4, color="C0")
    axis.set(xlabel=label, ylabel=f"ms {per}", xlim=(0, None), ylim=(0, 1.1 * upper.max()))


def _bars(axis: Any, report: dict[str, Any]) -> None:
    """Milliseconds an image, ours and the peers', on a logarithmic axis."""
    ours = 1e3 / report["images_per_second"]
    rows = {"roofline": report["roofline"]["ms_per_image"], "rgbavatar_ns": ours}
    for name, peer in report["peers"].items():
        if "unavailable" not in peer:
            rows[name] = peer["whole_ms_per_image"]
    names, values = list(rows), list(rows.values())
    colors = ["0.75", "C0"] + ["C1"] * (len(rows) - 2)
    axis.barh(names, values, color=colors)
    for position, value in enumerate(values):
        axis.text(1.1 * value, position, f"{value:.3g}", va="center", fontsize=8)
    axis.set(xscale="log", xlabel="ms an image", xlim=(0.5 * min(values), 6 * max(values)))
    axis.invert_yaxis()


def draw_again(measured: Path, path: Path) -> None:
    """Draw what `--json` wrote; raises UserError where it is something else."""
    try:
        draw(load_json(measured), path)
    except (DamagedFileError, LookupError, TypeError, ValueError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise UserError(
            f"{measured} holds no figures of this script: {reason}.",
            "Give --from-json a file that --json wrote.",
        ) from error


def main() -> None:
    """Measure, or read what was measured, and draw."""
    options = tyro.cli(Options, description=__doc__)
    if options.from_json is None:
        figures = measure(options)
        if options.json:
            write_json(options.json, figures)
        draw(figures, options.output)
    else:
        draw_again(options.from_json, options.output)
    print(options.output)


if __name__ == "__main__":
    with told_without_traceback("plots.py"):
        main()
