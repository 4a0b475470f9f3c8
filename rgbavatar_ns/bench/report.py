"""A benchmark's figures: as JSON for programs, as a table for people."""

from dataclasses import asdict, dataclass, field
from typing import Any

from rich.console import Console
from rich.table import Column, Table

from rgbavatar_ns.bench.machine import machine_facts
from rgbavatar_ns.bench.timing import Spread


@dataclass(frozen=True)
class Report:
    """What a benchmark found; None where a figure does not apply.

    `forward_ms_per_image` and `backward_ms_per_image` are the rasterizer's, or of a rendering the
    whole way from theta to the image, which has no backward.
    `parts` are milliseconds a batch; `spread` has median and quartiles in milliseconds a batch.
    """

    benchmark: str
    workload: dict[str, Any]
    images_per_second: float
    spread: dict[str, Spread]
    bytes_per_image: int | None
    """Memory of one call (see `timing.peak_growth_bytes`)."""
    roofline: dict[str, Any]
    peers: dict[str, Any]
    forward_ms_per_image: float | None = None
    backward_ms_per_image: float | None = None
    frames_per_second: float | None = None
    trainer: dict[str, Any] | None = None
    machine: dict[str, Any] = field(default_factory=machine_facts)

    @property
    def parts(self) -> dict[str, float]:
        """The medians."""
        return {name: spread.median_ms for name, spread in self.spread.items()}

    def to_json(self) -> dict[str, Any]:
        """The same as plain values."""
        return asdict(self) | {"parts": self.parts}


def print_report(report: Report) -> None:
    """Print the figures as tables."""
    console = Console(highlight=False)
    images = report.workload["batch"]
    console.rule(f"rgbavatar bench {report.benchmark}")
    console.print(_facts(report.workload))
    console.print(_facts(report.machine))
    console.print(_times(report, images))
    for line in _figures(report):
        console.print(line)
    if report.peers:
        console.print(_peers(report.peers))


def _facts(facts: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in facts.items() if value is not None)


def _table(first: str, *figures: str) -> Table:
    return Table(first, *(Column(heading, justify="right") for heading in figures))


def _times(report: Report, images: int) -> Table:
    table = _table("part", "ms a batch", "quartiles", "ms an image")
    for name, spread in report.spread.items():
        table.add_row(
            name,
            f"{spread.median_ms:.2f}",
            f"{spread.lower_ms:.2f} - {spread.upper_ms:.2f}",
            f"{spread.median_ms / images:.3f}",
        )
    return table


def _figures(report: Report) -> list[str]:
    """The lines below the table."""
    lines = []
    forward, backward = report.forward_ms_per_image, report.backward_ms_per_image
    if forward is not None and backward is not None:
        lines.append(f"rasterizer: {forward:.2f} ms an image forward, {backward:.2f} ms backward")
    if report.frames_per_second is not None:
        lines.append(f"{report.frames_per_second:.1f} frames/s")
    else:
        lines.append(f"{report.images_per_second:.1f} images/s")
    roofline = report.roofline
    lines.append(
        f"roofline {roofline['ms_per_image']:.2f} ms an image (arithmetic "
        f"{roofline['arithmetic_ms_per_image']:.2f}, memory "
        f"{roofline['traffic_ms_per_image']:.2f}; "
        f"{roofline['lane_operations_per_second'] / 1e9:.0f} G lane operations/s, "
        f"{roofline['bytes_per_second'] / 1e9:.1f} GB/s), reached "
        f"{100 * roofline['reached']:.0f} %"
    )
    lines.append(f"{roofline['pairs_per_image'] / 1e6:.2f} M (pixel, Gaussian) pairs an image")
    if report.bytes_per_image is not None:
        lines.append(f"{report.bytes_per_image / 2**20:.1f} MiB of memory an image")
    if report.trainer is not None:
        trainer = report.trainer
        lines.append(
            f"nerfstudio's trainer: {trainer['images_per_second']:.1f} images/s over "
            f"{trainer['steps']} steps, {100 * trainer['share_of_bare_step']:.0f} % of the bare "
            f"step's {trainer['bare_images_per_second']:.1f} ({trainer['bare_step']})"
        )
    return lines


def _peers(peers: dict[str, Any]) -> Table:
    table = _table("beside it", "forward ms", "backward ms", "whole ms", "times ours")
    for name, figures in peers.items():
        if "unavailable" in figures:
            table.add_row(name, f"unavailable: {figures['unavailable']}")
            continue
        keys = ("forward_ms_per_image", "backward_ms_per_image", "whole_ms_per_image", "ratio")
        table.add_row(name, *(f"{figures[key]:.1f}" if key in figures else "-" for key in keys))
    return table
