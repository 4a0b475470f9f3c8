"""`rgbavatar report`: tables and plots of what a sweep has done so far."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.markdown import Markdown

from rgbavatar_ns.cli.console import plain_console
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments import read_experiment
from rgbavatar_ns.experiments.report import write_report
from rgbavatar_ns.experiments.results import write_page, write_results
from rgbavatar_ns.experiments.source import read_sources


def run(
    folders: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
    file: Path | None = None,
    subjects: tuple[str, ...] | None = None,
    tiny: bool = False,
    plots: bool = True,
    into: Path | None = None,
) -> None:
    """Write each sweep's table as Markdown, CSV and LaTeX, its plots, and a page with all.

    Args:
        folders: where `rgbavatar sweep` wrote.
        file: the experiment that was swept; by default all that the folder says was swept there.
        subjects: with --file: it was swept with these.
        tiny: with --file: it was swept with --tiny.
        plots: draw them too (needs matplotlib).
        into: instead, write what the folders tell as INTO/results/NAME.json with small pictures,
            and INTO/results.md from all results that lie there; without folders that page alone.
    """
    console = plain_console()
    paths: list[Path] = []
    if into is not None:
        for folder in folders:
            paths += write_results(folder, into)
        paths.append(write_page(into))
    elif not folders:
        raise UserError(
            "There is no sweep to report on.", "Name the folder that `rgbavatar sweep` wrote."
        )
    else:
        for folder in folders:
            if file is not None:
                experiments = [read_experiment(file, tiny=tiny, subjects=subjects)]
            else:
                experiments = [source.experiment for source in read_sources(folder)]
            for experiment in experiments:
                report = write_report(experiment, folder, plots=plots)
                console.print(Markdown(report.table.to_markdown()), soft_wrap=False)
                paths += report.paths
    for path in paths:
        console.print(str(path))
