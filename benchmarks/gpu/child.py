"""A section in the process that is its own, so that its end ends nothing else."""

import faulthandler
import importlib
import os
import signal
import traceback

from benchmarks.gpu.rows import Rows, SectionEnded
from benchmarks.gpu.sections import Section


def run_section(section: Section, rows: Rows) -> int:
    """Ask the section's questions; 1 where it ended early without saying why in a row."""
    module, function = section.place.split(":")
    try:
        getattr(importlib.import_module(f"benchmarks.gpu.{module}"), function)(rows)
    except SectionEnded:
        return 0
    except Exception:
        traceback.print_exc()
        return 1
    return 0


def child(section: Section, rows_file: int) -> int:
    """As `run_section`, with rows written to an open file.

    A process that is told to end where it hangs says where that is.
    """
    faulthandler.enable()
    faulthandler.register(signal.SIGTERM, chain=True)
    status = run_section(section, Rows(lambda line: os.write(rows_file, line.encode())))
    os.close(rows_file)
    return status
