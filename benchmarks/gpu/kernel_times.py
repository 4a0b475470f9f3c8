"""How long each kernel of a recorded step takes, by the GPU's own clock."""

import json
import os
import statistics
import tempfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from benchmarks.gpu.rows import Figures, LeftOut, Rows
from benchmarks.gpu.workload import Training, Workload
from rgbavatar_ns.kernels.cuda.source import kernels as own_kernels

_CATEGORIES = ("kernel", "gpu_memcpy", "gpu_memset")
_LONGEST_NAME = 100
_SUFFIX = "_kernel"


def kernels(rows: Rows) -> None:
    """Times by name, most first, and the whole between events around each call."""
    # CUPTI must not be taken down and set up again between recordings (pytorch issue 75504).
    os.environ["DISABLE_CUPTI_LAZY_REINIT"], os.environ["TEARDOWN_CUPTI"] = "1", "0"
    work = Workload.here()
    with rows.row("whole") as figures:
        take = Training(work).recorded()
        whole_us = [event_us(work, take) for _ in range(work.calls)]
        figures |= {"median_us": statistics.median(whole_us), "least_us": min(whole_us)}
    with rows.row("by_name") as figures:
        traced(work, work.wait)  # the profiler knows graphs that are recorded after it has begun
        by_name = kernel_times(traced(work, Training(work).recorded()), work.calls)
        if not by_name:
            raise LeftOut(
                "The profiler saw no kernel.",
                "Its library, CUPTI, comes with torch's CUDA packages (nvidia-cuda-cupti); another "
                "profiler on the GPU keeps it out.",
            )
        own, others = shares(by_name)
        busy_us = sum(each["step_us"] for each in by_name.values())
        figures |= {
            "busy_us": busy_us,
            "busy_share_of_whole": busy_us / statistics.median(whole_us),
            "launches": sum(each["launches"] for each in by_name.values()),
            "own": own,
            "others_us": sum(each["step_us"] for each in others.values()),
            "others": dict(list(others.items())[:12]),
        }


def event_us(work: Workload, call: Callable[[], Any]) -> float:
    """Microseconds on the GPU from before the call to after it; 0 on what stands for one."""
    if not work.on_gpu:
        call()
        return 0.0
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    call()
    end.record()
    end.synchronize()
    return 1e3 * start.elapsed_time(end)


def traced(work: Workload, call: Callable[[], Any]) -> list[dict[str, Any]]:
    """What the profiler saw of so many calls: the events of its trace file."""
    activity = torch.profiler.ProfilerActivity
    activities = [activity.CPU, activity.CUDA] if work.on_gpu else [activity.CPU]
    work.wait()
    with torch.profiler.profile(activities=activities) as profile:
        for _ in range(work.calls):
            call()
        work.wait()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        profile.export_chrome_trace(str(path))
        return json.loads(path.read_text())["traceEvents"]


def kernel_times(events: Iterable[Mapping[str, Any]], calls: int) -> dict[str, Figures]:
    """Times by kernel, most first, from a trace's events of so many equal calls.

    Of each: the median of a launch, the median of a call's launches together, how many a call has,
    and what the trace says of registers, shared memory and occupancy.
    """
    by_name: dict[str, list[Mapping[str, Any]]] = {}
    for event in events:
        if event.get("ph") == "X" and event.get("cat") in _CATEGORIES:
            by_name.setdefault(short_name(event["name"]), []).append(event)
    found = {}
    for name, launches in by_name.items():
        launches.sort(key=lambda event: event["ts"])
        each_us = [float(event["dur"]) for event in launches]
        found[name] = {
            "median_us": statistics.median(each_us),
            "step_us": _of_a_call(each_us, calls),
            "launches": len(each_us) / calls,
            **_facts(launches[-1].get("args", {})),
        }
    return dict(sorted(found.items(), key=lambda item: -item[1]["step_us"]))


def _of_a_call(each_us: list[float], calls: int) -> float:
    """The median of the calls' sums; their mean where calls launch unequally often."""
    count, rest = divmod(len(each_us), calls)
    if rest:
        return sum(each_us) / calls
    return statistics.median(
        sum(each_us[first : first + count]) for first in range(0, len(each_us), count)
    )


def _facts(arguments: Mapping[str, Any]) -> Figures:
    names = {
        "registers per thread": "registers",
        "shared memory": "shared_bytes",
        "est. achieved occupancy %": "estimated_occupancy_percent",
        "grid": "grid",
        "block": "block",
    }
    return {ours: arguments[theirs] for theirs, ours in names.items() if theirs in arguments}


def short_name(name: str) -> str:
    """Ours as the sources name them, others cut."""
    bare = name.split("(")[0].removesuffix(_SUFFIX)
    return bare if bare in own_kernels() else name[:_LONGEST_NAME]


def shares(by_name: Mapping[str, Figures]) -> tuple[dict[str, Figures], dict[str, Figures]]:
    """Our kernels and others', each with its share of all kernels' time."""
    whole_us = sum(each["step_us"] for each in by_name.values())
    told = {n: {**each, "share": each["step_us"] / whole_us} for n, each in by_name.items()}
    own = {name: each for name, each in told.items() if name in own_kernels()}
    return own, {name: each for name, each in told.items() if name not in own}
