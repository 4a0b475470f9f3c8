"""Plots of an experiment as PNG and SVG."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.spec import Experiment
from rgbavatar_ns.experiments.streamed import read_streamed
from rgbavatar_ns.experiments.sweep import CellStatus
from rgbavatar_ns.experiments.tables import HEADINGS, ResultTable, Row

_COLOR = "tab:blue"
# Values that spread by more than this factor get a logarithmic axis.
_WIDE = 8


def write_plots(experiment: Experiment, table: ResultTable, folder: Path, stem: str) -> list[Path]:
    """Draw the metrics against `experiment.plot`, or as bars by variant; returns the PNG paths.

    Raises UserError where matplotlib is missing.
    """
    metrics = [m for m in table.metrics if any(m in row.entries for row in table.rows)]
    if not metrics:
        return []
    figure = _figure(4.2 * len(metrics), 3.2)
    for place, metric in enumerate(metrics, 1):
        axes = figure.add_subplot(1, len(metrics), place)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(HEADINGS[metric], fontsize=10)
        rows = [row for row in table.rows if metric in row.entries]
        if experiment.plot is not None:
            _against(axes, experiment, rows, metric)
            continue
        means = [row.entries[metric].mean for row in rows]
        spreads = [row.entries[metric].spread for row in rows]
        axes.barh([row.name for row in rows], means, xerr=spreads, color=_COLOR, height=0.6)
        axes.invert_yaxis()
        low, high = min(means), max(means)
        margin = max(high - low, 1e-3 * abs(high), 1e-9)
        axes.set_xlim(low - 0.6 * margin, high + 0.3 * margin)
    return [_saved(figure, folder, stem)]


def write_forgetting_curves(statuses: Sequence[CellStatus], folder: Path, stem: str) -> list[Path]:
    """Draw the loss of each streamed frame after the stream's end, a line for each variant.

    Of the first cell of each that has such a curve; returns the PNG's path, or nothing where no
    cell has one. Raises UserError where matplotlib is missing.
    """
    curves: dict[str, tuple[list[int], list[float]]] = {}
    for status in statuses:
        curve = read_streamed(status.folder) if status.result is not None else None
        if curve is not None:
            curves.setdefault(status.cell.variant, curve)
    if not curves:
        return []
    figure = _figure(8.4, 3.6)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("frame of the stream")
    axes.set_ylabel("L1 after the stream's end")
    for name, (frames, losses) in curves.items():
        axes.plot(frames, _smooth(losses), linewidth=1, label=name)
    axes.legend(frameon=False, fontsize=7)
    return [_saved(figure, folder, f"{stem}_forgetting")]


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


def _saved(figure: Any, folder: Path, stem: str) -> Path:
    """Write PNG and SVG; returns the PNG's path."""
    path = folder / f"{stem}.png"
    figure.savefig(path, dpi=130)
    figure.savefig(path.with_suffix(".svg"))
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
            [rows[k].entries[metric].mean for k in mine],
            yerr=[rows[k].entries[metric].spread for k in mine],
            marker="o",
            linestyle="-" if places is numbers else "",
            capsize=2,
            label=family,
        )
    if places is numbers and min(numbers) > 0 and max(numbers) / min(numbers) > _WIDE:
        axes.set_xscale("log", base=2)
    shown = dict(zip(places, values))
    axes.set_xticks(list(shown), [str(value) for value in shown.values()])
    axes.minorticks_off()
    if len(families) > 1:
        axes.legend(frameon=False)
