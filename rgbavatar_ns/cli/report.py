"""`rgbavatar report`: tables and plots of what a sweep has done so far."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markdown import Markdown

from rgbavatar_ns.experiments import read_experiment
from rgbavatar_ns.experiments.report import write_report


def run(
    folder: Annotated[Path, tyro.conf.Positional],
    file: Path,
    subjects: tuple[str, ...] | None = None,
    tiny: bool = False,
    plots: bool = True,
) -> None:
    """Write the experiment's table as Markdown, CSV and LaTeX, its plot, and a page with all.

    Args:
        folder: where `rgbavatar sweep` wrote.
        file: the experiment that was swept.
        subjects: it was swept with these.
        tiny: it was swept with --tiny.
        plots: draw them too (needs matplotlib).
    """
    experiment = read_experiment(file, tiny=tiny, subjects=subjects)
    report = write_report(experiment, folder, plots=plots)
    console = Console()
    console.print(Markdown(report.table.to_markdown()))
    for path in report.paths:
        console.print(str(path), soft_wrap=True, highlight=False)
