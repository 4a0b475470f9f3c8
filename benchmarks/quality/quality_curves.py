"""Draw docs/time_to_quality.png from what `rgbavatar bench quality --json` wrote: a panel a file.

    rgbavatar bench quality --json demo.json
    rgbavatar bench quality --data speaker --json speaker.json
    python benchmarks/quality/quality_curves.py demo.json speaker.json

Thick lines are means over the subjects, thin ones single subjects; dots are where means come
within half a decibel of the first way's end.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from rgbavatar_ns.bench.quality import QualityReport, seconds_to


def read(path: Path) -> QualityReport:
    """A report as it was written."""
    report = QualityReport.read(path)
    if report is None:
        raise SystemExit(f"{path} is no report of `rgbavatar bench quality --json`.")
    return report


def draw(reports: Sequence[QualityReport], path: Path) -> None:
    """Write the panels as a PNG."""
    figure = Figure(figsize=(4.6 * len(reports), 3.4), layout="constrained")
    for axes, report in zip(figure.subplots(1, len(reports), squeeze=False)[0], reports):
        _panel(axes, report)
    facts = reports[0].machine
    figure.supxlabel(
        f"{facts['processor']}, {reports[0].workload['threads']} thread, "
        f"{facts['instruction_set']}, commit {facts['commit']}, {facts['date'][:10]}",
        fontsize=7,
        color="0.4",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _panel(axes: Any, report: QualityReport) -> None:
    means = report.means()
    first = next(iter(means.values()))
    end_db = first[max(first)] - report.within_db
    axes.axhline(end_db, color="0.7", lw=0.8, ls="--")
    for number, (name, mean) in enumerate(means.items()):
        color, reached = f"C{number}", seconds_to(end_db, mean)
        for single in report.curves[name]:
            axes.plot(*zip(*sorted(single.items())), color=color, lw=0.6, alpha=0.5)
        label = f"{name} images a step"
        if reached is not None:
            label += f": {reached:.1f} s"
            axes.plot(reached, end_db, "o", color=color, ms=5)
        axes.plot(*zip(*sorted(mean.items())), color=color, lw=2, label=label)
    axes.set(xlabel="seconds of training steps", ylabel="held-out PSNR, dB")
    axes.set_title(Path(str(report.workload["data"])).name, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)


def main() -> None:
    """Read and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("reports", type=Path, nargs="+", help="JSON of `rgbavatar bench quality`")
    parser.add_argument("--output", type=Path, default=Path("docs/time_to_quality.png"))
    given = parser.parse_args()
    draw([read(path) for path in given.reports], given.output)


if __name__ == "__main__":
    main()
