"""`rgbavatar bench`: how fast rasterizer, training step and rendering are, and how soon good."""

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from rgbavatar_ns.bench.options import (
    QualityOptions,
    RasterizerOptions,
    RenderOptions,
    StepOptions,
)
from rgbavatar_ns.files import disk_errors, write_json

if TYPE_CHECKING:
    from rgbavatar_ns.bench.report import Report
    from rgbavatar_ns.bench.timing import Progress as Told

Options = (
    Annotated[RasterizerOptions, tyro.conf.subcommand("rasterizer", prefix_name=False)]
    | Annotated[StepOptions, tyro.conf.subcommand("step", prefix_name=False)]
    | Annotated[RenderOptions, tyro.conf.subcommand("render", prefix_name=False)]
    | Annotated[QualityOptions, tyro.conf.subcommand("quality", prefix_name=False)]
)

_SECONDS_PER_REFRESH = 0.2


def run(options: Annotated[Options, tyro.conf.arg(name="")]) -> None:
    """Measure on this machine: medians, parts, roofline, what else draws the same; quality by time.

    Other programs that run meanwhile make every figure worse.
    """
    from rgbavatar_ns.bench.report import print_report

    if options.json is not None:
        _require_writable(options.json)
    if isinstance(options, QualityOptions):
        return _measure_quality(options)
    with _progress() as told:
        report = _measure(options, told)
    print_report(report)
    if options.json is not None:
        write_json(options.json, report.to_json())


def _measure(options: RasterizerOptions | StepOptions | RenderOptions, told: "Told") -> "Report":
    if isinstance(options, RasterizerOptions):
        from rgbavatar_ns.bench.rasterizer import bench_rasterizer

        return bench_rasterizer(options, told)
    if isinstance(options, StepOptions):
        from rgbavatar_ns.bench.step import bench_step

        return bench_step(options, told)
    from rgbavatar_ns.bench.render import bench_render

    return bench_render(options, told)


def _measure_quality(options: QualityOptions) -> None:
    from rgbavatar_ns.bench.quality import QualityReport, bench_quality, print_quality

    def keep(report: QualityReport) -> None:
        if options.json is not None:
            write_json(options.json, report.to_json())

    begun = None if options.json is None else QualityReport.read(options.json)
    with _progress() as told:
        report = bench_quality(options, told, keep, begun)
    print_quality(report)


def _require_writable(path: Path) -> None:
    """Raise UserError before minutes are spent on figures that cannot be written."""
    with disk_errors(path, "Give --json a path you can write to."):
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass


@contextmanager
def _progress() -> "Iterator[Told]":
    """A bar that is drawn between timings only, since drawing takes the processor's time too."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, auto_refresh=False, transient=True) as bar:
        task = bar.add_task("", total=None, rate="")
        shown = began = 0.0
        current = ""

        def told(what: str, done: int, total: int) -> None:
            nonlocal shown, began, current
            now = time.monotonic()
            if what != current:
                current, began = what, now
            elif now - shown < _SECONDS_PER_REFRESH:
                return
            shown = now
            rate = f"{done / (now - began):.1f}/s" if done and now > began else ""
            bar.update(task, description=what, completed=done, total=total, rate=rate)
            bar.refresh()

        yield told
