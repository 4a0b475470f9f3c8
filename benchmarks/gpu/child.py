"""A section in the process that is its own, so that its end ends nothing else."""

import faulthandler
import importlib
import os
import signal
import traceback
from contextlib import suppress

from benchmarks.gpu.rows import Rows, SectionEnded
from benchmarks.gpu.sections import Section


def run_section(section: Section, rows: Rows) -> None:
    """Ask the section's questions; what is raised between its rows becomes one."""
    module, function = section.place.split(":")
    with suppress(SectionEnded):
        try:
            getattr(importlib.import_module(f"benchmarks.gpu.{module}"), function)(rows)
        except SectionEnded:
            raise
        except Exception:
            traceback.print_exc()
            with rows.row("between_rows"):
                raise


def child(section: Section, rows_file: int) -> None:
    """As `run_section`, with rows written to an open file.

    A process that is told to end where it hangs says where that is.
    """
    faulthandler.enable()
    faulthandler.register(signal.SIGTERM, chain=True)
    run_section(section, Rows(lambda line: os.write(rows_file, line.encode())))
    os.close(rows_file)
