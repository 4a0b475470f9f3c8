"""Nsight Compute over one step: how busy each of our kernels keeps the GPU."""

import csv
import re
import statistics
from collections.abc import Iterator

from benchmarks.gpu.rows import Figures, LeftOut, Rows, check
from benchmarks.gpu.tools import CASES_SECONDS, required_tool, run_case
from rgbavatar_ns.kernels.cuda.source import kernels

NAME = "ncu"
METRICS = {
    "gpu__time_duration.sum": "duration_ns",
    "sm__throughput.avg.pct_of_peak_sustained_elapsed": "sm_percent",
    "gpu__dram_throughput.avg.pct_of_peak_sustained_elapsed": "dram_percent",
    "sm__warps_active.avg.pct_of_peak_sustained_active": "occupancy_percent",
}
_KERNEL, _METRIC, _VALUE = "Kernel Name", "Metric Name", "Metric Value"
_FORBIDDEN = "ERR_NVGPUCTRPERM"


def ncu(rows: Rows) -> None:
    """A row for all kernels of a step."""
    with rows.row("step") as figures:
        program = required_tool(NAME)
        names = "|".join(kernels())
        options = ["--csv", "--page", "raw", "--print-units", "base", "--profile-from-start", "off"]
        options += ["--target-processes", "all", "--metrics", ",".join(METRICS)]
        options += ["--kernel-name", f"regex:^({names})_kernel$"]
        ran = run_case([program, *options], "profiled", {}, CASES_SECONDS)
        if _FORBIDDEN in ran.text:
            raise LeftOut(
                "The driver shows its counters to administrators only.",
                "Run as root, in a container with --cap-add SYS_ADMIN, or load the driver with "
                "NVreg_RestrictProfilingToAdminUsers=0.",
            )
        figures |= {"seconds": ran.seconds, **counters(ran.text)}
        if not counters(ran.text):
            check(figures, False, "it measured no kernel: " + ran.text[-1500:])


def counters(text: str) -> dict[str, Figures]:
    """The medians over each kernel's launches, from ncu's CSV in either of its two forms.

    One row a launch with a column a metric (--page raw), or one row a metric.
    """
    values: dict[str, dict[str, list[float]]] = {}
    for row in _table(text):
        kernel = re.sub(r"_kernel\b.*", "", row[_KERNEL])
        told = {row[_METRIC]: row[_VALUE]} if _METRIC in row else row
        for metric, ours in METRICS.items():
            number = _number(told.get(metric))
            if number is not None:
                values.setdefault(kernel, {}).setdefault(ours, []).append(number)
    return {
        kernel: {
            "launches": max(map(len, found.values())),
            **{name: statistics.median(each) for name, each in found.items()},
        }
        for kernel, found in values.items()
    }


def _table(text: str) -> Iterator[dict[str, str]]:
    """The rows of the table that stands among a program's and the tool's other lines."""
    lines = [line for line in text.splitlines() if line.startswith('"')]
    heads = [number for number, line in enumerate(lines) if f'"{_KERNEL}"' in line]
    if heads:
        yield from (row for row in csv.DictReader(lines[heads[0] :]) if row[_KERNEL])


def _number(text: str | None) -> float | None:
    try:
        return float((text or "").replace(",", ""))
    except ValueError:
        return None
