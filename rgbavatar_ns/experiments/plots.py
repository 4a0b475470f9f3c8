"""Plots of an experiment as PNG and SVG."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.columns import COLUMNS
from rgbavatar_ns.experiments.kept import kept_curve
from rgbavatar_ns.experiments.runner import run_folder_of
from rgbavatar_ns.experiments.spec import Experiment
from rgbavatar_ns.experiments.streamed import StreamedCurve, read_streamed
from rgbavatar_ns.experiments.sweep import CellStatus
from rgbavatar_ns.experiments.tables import Entry, ResultTable, Row
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.plugin.training.curve import CURVE_NAME, read_curve

_COLOR = "tab:blue"
# Values that spread by more than this factor get a logarithmic axis.
_WIDE = 8
_COLUMNS = 3


def write_plots(experiment: Experiment, table: ResultTable, folder: Path, stem: str) -> list[Path]:
    """Draw the metrics against `experiment.plot`, or as points by variant; returns the PNG paths.

    Raises UserError where matplotlib is missing.
    """
    metrics = [m for m in table.metrics if any(m in row.entries for row in table.rows)]
    if not metrics:
        return []
    figure, panels = _panels(len(metrics), 3.2, sharey=experiment.plot is None)
    for axes, metric in zip(panels, metrics):
        axes.set_title(COLUMNS[metric].heading, fontsize=10)
        rows = [row for row in table.rows if metric in row.entries]
        if experiment.plot is not None:
            _against(axes, experiment, rows, metric)
            continue
        places = [table.rows.index(row) for row in rows]
        means = [_mean(row.entries[metric]) for row in rows]
        spreads = [_spread(row.entries[metric]) for row in rows]
        # Points, not bars: these would have to begin at 0, where differences do not show.
        axes.errorbar(means, places, xerr=spreads, fmt="o", color=_COLOR, capsize=2)
        axes.set_yticks(range(len(table.rows)), [row.shown_name for row in table.rows])
        axes.set_ylim(len(table.rows) - 0.5, -0.5)
        axes.set_xlim(*_fair_range(metric, axes.get_xlim()))
        axes.locator_params(axis="x", nbins=5)
        axes.grid(axis="y", alpha=0.3)
    return [_saved(figure, folder, stem)]


def write_forgetting_curves(statuses: Sequence[CellStatus], folder: Path, stem: str) -> list[Path]:
    """Draw what each streamed frame's loss is after the end, and the least it ever was.

    A panel for each variant, of its first cell that has such a curve (paper, supplement: with and
    without global sampling). Returns the PNG's path, or nothing where no cell has a curve. Raises
    UserError where matplotlib is missing.
    """
    curves: dict[str, StreamedCurve] = {}
    for status in statuses:
        curve = read_streamed(status.folder) if status.result is not None else None
        if curve is not None:
            curves.setdefault(status.cell.variant, curve)
    if not curves:
        return []
    figure, panels = _panels(len(curves), 2.8, sharex=True, sharey=True)
    for axes, (name, curve) in zip(panels, curves.items()):
        shown = curve.least or curve.after
        after = [curve.after[frame] for frame in shown]
        axes.plot(list(shown), _smooth(after), linewidth=1, label="after the stream's end")
        if curve.least:
            least = _smooth(list(curve.least.values()))
            axes.plot(list(shown), least, linewidth=1, label="the least in training")
        forgotten = "" if curve.forgotten is None else f": {curve.forgotten:.5f} forgotten"
        axes.set_title(f"{name}{forgotten}", fontsize=9)
        axes.set_xlabel("frame of the stream")
        axes.set_ylabel("L1")
    panels[0].legend(frameon=False, fontsize=7)
    return [_saved(figure, folder, f"{stem}_forgetting")]


def write_convergence(
    experiment: Experiment, statuses: Sequence[CellStatus], folder: Path, stem: str
) -> list[Path]:
    """Draw held-out PSNR against seconds of training, a line for each variant.

    Cells have points where `steps_per_eval_all_images` asked for them; seconds are those of the
    steps alone, and the last point is the end's. Of several subjects or seeds each is a thin line,
    and the thick one is the mean at steps that all have. Raises UserError where matplotlib is
    missing.
    """
    curves = {
        variant.name: [
            points
            for status in statuses
            if status.cell.variant == variant.name and (points := convergence(status))
        ]
        for variant in experiment.variants
    }
    curves = {name: found for name, found in curves.items() if found}
    if not curves:
        return []
    figure = _figure(6.4, 4.0)
    axes = figure.add_subplot()
    _plain(axes)
    axes.set_xlabel("training, s")
    axes.set_ylabel(COLUMNS["psnr"].heading)
    for place, (name, found) in enumerate(curves.items()):
        color = f"C{place}"
        if len(found) > 1:
            for points in found:
                axes.plot(*zip(*points.values()), color=color, linewidth=0.6, alpha=0.4)
        steps = sorted(set.intersection(*(set(points) for points in found)))
        means = np.mean([[points[step] for step in steps] for points in found], axis=0)
        axes.plot(*means.reshape(-1, 2).T, color=color, label=name, marker=".", markersize=4)
    axes.set_xlim(left=0)
    axes.set_ylim(*_fair_range("psnr", axes.get_ylim()))
    axes.legend(frameon=False)
    return [_saved(figure, folder, f"{stem}_convergence")]


def convergence(status: CellStatus) -> dict[int, tuple[float, float]]:
    """Seconds and PSNR by step of a finished cell, where it has one; empty without evaluations."""
    if status.result is None:
        return {}
    kept = kept_curve(status.result)
    if kept is not None:
        return kept
    points = read_curve(run_folder_of(status.folder, status.cell) / CURVE_NAME)
    seen = {
        int(point["step"]): (point["train_seconds"], point["psnr"])
        for point in points
        if "psnr" in point
    }
    ended = status.result["metrics"]
    if seen and {"steps", "train_seconds", "psnr"} <= ended.keys():
        seen[int(ended["steps"]) - 1] = (ended["train_seconds"], ended["psnr"])
    return seen


def _mean(entry: Entry) -> float:
    return math.nan if entry.mean is None else entry.mean


def _spread(entry: Entry) -> float:
    """Of an error bar; NaN draws none."""
    return math.nan if entry.spread is None else entry.spread


def _fair_range(metric: str, shown: tuple[float, float]) -> tuple[float, float]:
    """A range of an axis in which differences look no larger than they are.

    From 0, or as wide as `Column.least_span` about the same middle.
    """
    least, (low, high) = COLUMNS[metric].least_span, shown
    if least is None:
        return min(low, 0.0), high
    wider = max(0.0, least - (high - low)) / 2
    return low - wider, high + wider


def _plain(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)


def _smooth(values: Sequence[float]) -> np.ndarray:
    """Means over a fortieth of the frames: single expressions would hide the slope."""
    width = max(1, len(values) // 40)
    counts = np.convolve(np.ones(len(values)), np.ones(width), "same")
    return np.convolve(values, np.ones(width), "same") / counts


def _figure(width: float, height: float) -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError(
            f"Plots need matplotlib, which cannot be imported ({error}).",
            "Install it (pip install matplotlib), or pass --no-plots.",
        ) from error
    return Figure(figsize=(width, height), layout="constrained")


def _panels(count: int, height: float, **shared: bool) -> tuple[Any, list[Any]]:
    """A figure of so many panels, some in a row."""
    columns = min(count, _COLUMNS)
    rows = -(-count // columns)
    figure = _figure(4.2 * columns, height * rows)
    panels = list(figure.subplots(rows, columns, squeeze=False, **shared).flat)
    for axes in panels[count:]:
        axes.set_visible(False)
    for axes in panels:
        _plain(axes)
    return figure, panels[:count]


def _saved(figure: Any, folder: Path, stem: str) -> Path:
    """Write PNG and SVG; returns the PNG's path."""
    path = folder / f"{stem}.png"
    for place in (path, path.with_suffix(".svg")):
        with atomic_write(place) as partial:
            figure.savefig(partial, dpi=130)
    return path


def _against(axes: Any, experiment: Experiment, rows: Sequence[Row], metric: str) -> None:
    """A line for each family of variants, over the value of the override that the plot is about."""
    assert experiment.plot is not None
    axes.set_xlabel(experiment.plot.rsplit(".", 1)[-1])
    variants = {variant.name: variant for variant in experiment.variants}
    values = [variants[row.name].overrides.get(experiment.plot) for row in rows]
    numbers = [float(value) for value in values if isinstance(value, int | float)]
    places = numbers if len(numbers) == len(values) else list(range(len(values)))
    families = list(dict.fromkeys(variants[row.name].family for row in rows))
    for family in families:
        mine = [k for k, row in enumerate(rows) if variants[row.name].family == family]
        axes.errorbar(
            [places[k] for k in mine],
            [_mean(rows[k].entries[metric]) for k in mine],
            yerr=[_spread(rows[k].entries[metric]) for k in mine],
            marker="o",
            linestyle="-" if places is numbers else "",
            capsize=2,
            label=family,
        )
    axes.set_ylim(*_fair_range(metric, axes.get_ylim()))
    if places is numbers and min(numbers) > 0 and max(numbers) / min(numbers) > _WIDE:
        axes.set_xscale("log", base=2)
    shown = dict(zip(places, values))
    axes.set_xticks(list(shown), [str(value) for value in shown.values()])
    axes.minorticks_off()
    if len(families) > 1:
        axes.legend(frameon=False)
