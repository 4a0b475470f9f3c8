"""Plots of an experiment as PNG and SVG."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.spec import Experiment
from rgbavatar_ns.experiments.tables import HEADINGS, ResultTable, Row

_COLOR = "tab:blue"
# Values that spread by more than this factor get a logarithmic axis.
_WIDE = 8


def write_plots(experiment: Experiment, table: ResultTable, folder: Path, stem: str) -> list[Path]:
    """Draw the metrics against `experiment.plot`, or as bars by variant; returns the PNG paths.

    Raises UserError where matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError(
            f"Plots need matplotlib, which cannot be imported ({error}).",
            "Install it (pip install matplotlib), or pass --no-plots.",
        ) from error
    metrics = [m for m in table.metrics if any(m in row.entries for row in table.rows)]
    if not metrics:
        return []
    figure = Figure(figsize=(4.2 * len(metrics), 3.2), layout="constrained")
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
    paths = []
    for suffix in (".png", ".svg"):
        path = folder / f"{stem}{suffix}"
        figure.savefig(path, dpi=130)
        paths.append(path)
    return paths[:1]


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
