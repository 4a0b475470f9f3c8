"""A benchmark's figures: as JSON for programs, as a table for people."""

from dataclasses import asdict, dataclass, field
from typing import Any

from rich.console import Console
from rich.table import Table

from rgbavatar_ns.bench.timing import Spread


@dataclass(frozen=True)
class Report:
    """What a benchmark found; None where a figure does not apply.

    `forward_ms_per_image` and `backward_ms_per_image` are the rasterizer's alone, also beside a
    step, whose own loops do both at once; of a rendering they are the whole way from theta to the
    image, which has no backward.
    `parts` are milliseconds a batch; `spread` has median and quartiles in milliseconds a batch.
    """

    benchmark: str
    workload: dict[str, Any]
    forward_ms_per_image: float | None
    backward_ms_per_image: float | None
    images_per_second: float | None
    frames_per_second: float | None
    parts: dict[str, float]
    spread: dict[str, Spread]
    pairs: dict[str, float]
    memory: dict[str, Any]
    floor: dict[str, Any]
    peers: dict[str, Any]
    machine: dict[str, Any]
    trainer: dict[str, Any] | None = field(default=None)
    gpu_utilisation_percent: float | None = None
    gpu_utilisation_note: str | None = None
    """How it was measured, or why it was not; None on a CPU."""

    def to_json(self) -> dict[str, Any]:
        """The same as plain values."""
        return asdict(self)


def print_report(report: Report, console: Console | None = None) -> None:
    """Print the figures as tables."""
    console = console or Console(highlight=False)
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


def _times(report: Report, images: int) -> Table:
    table = Table("part", "ms a batch", "quartiles", "ms an image", title_justify="left")
    for column in table.columns[1:]:
        column.justify = "right"
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
    elif report.images_per_second is not None:
        lines.append(f"{report.images_per_second:.1f} images/s")
    floor, pairs = report.floor, report.pairs
    lines.append(
        f"floor {floor['ms_per_image']:.2f} ms an image (arithmetic "
        f"{floor['arithmetic_ms_per_image']:.2f}, memory {floor['traffic_ms_per_image']:.2f}; "
        f"{floor['lane_operations_per_second'] / 1e9:.0f} G lane operations/s, "
        f"{floor['bytes_per_second'] / 1e9:.1f} GB/s), reached {100 * floor['reached']:.0f} %"
    )
    lines.append(
        f"{pairs['per_image'] / 1e6:.2f} M (pixel, Gaussian) pairs an image, "
        f"{pairs['per_second'] / 1e6:.0f} M pairs/s"
    )
    growth = report.memory["bytes_per_image"]
    if growth is not None:
        lines.append(f"{growth / 2**20:.1f} MiB of memory an image")
    if report.gpu_utilisation_note is not None:
        percent = report.gpu_utilisation_percent
        told = "not measured" if percent is None else f"{percent:.0f} %"
        lines.append(f"GPU utilisation: {told} ({report.gpu_utilisation_note})")
    if report.trainer is not None:
        trainer = report.trainer
        lines.append(
            f"nerfstudio's trainer: {trainer['images_per_second']:.1f} images/s over "
            f"{trainer['steps']} steps, {100 * trainer['share_of_bare_step']:.0f} % of the bare "
            f"step's {trainer['bare_images_per_second']:.1f}"
        )
    return lines


def _peers(peers: dict[str, Any]) -> Table:
    table = Table("peer", "forward ms", "backward ms", "whole ms", "times ours", "MiB an image")
    for column in table.columns[1:]:
        column.justify = "right"
    for name, figures in peers.items():
        if "unavailable" in figures:
            table.add_row(name, f"unavailable: {figures['unavailable']}")
            continue
        growth = figures.get("bytes_per_image")
        table.add_row(
            name,
            _number(figures.get("forward_ms_per_image")),
            _number(figures.get("backward_ms_per_image")),
            _number(figures.get("whole_ms_per_image")),
            _number(figures.get("ratio")),
            "-" if growth is None else f"{growth / 2**20:.0f}",
        )
    return table


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
