"""NVIDIA's command-line tools, where a machine may have them."""

import glob
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.gpu.rows import LeftOut

ROOT = Path(__file__).resolve().parents[2]
CASES_SECONDS = 52.0
"""What a tool is given in a section: less than its limit, so that what it said is told; where the
budget leaves less than this, the section is cut short."""
REMEDIES = {
    "compute-sanitizer": "pip install nvidia-cuda-sanitizer-api, or the CUDA toolkit.",
    "ncu": "Install Nsight Compute (developer.nvidia.com/nsight-compute, or the CUDA toolkit).",
    "nvidia-smi": "It comes with the driver; in a container start with --gpus all.",
}


def tool(name: str) -> str | None:
    """The path of a tool by its name; None where it is nowhere.

    In PATH, CUDA_HOME or CUDA_PATH, the usual places of toolkits, and what pip installs.
    """
    homes = [os.environ.get(variable) for variable in ("CUDA_HOME", "CUDA_PATH")]
    folders = [f"{home}/bin" for home in homes if home]
    folders += ["/usr/local/cuda/bin", "/usr/local/cuda-*/bin", "/opt/nvidia/nsight-compute/*"]
    packages = {sysconfig.get_paths()[kind] for kind in ("purelib", "platlib")}
    folders += [f"{package}/nvidia/*/bin" for package in sorted(packages)]
    found = shutil.which(name)
    if found is not None:
        return found
    found_in = [sorted(glob.glob(f"{folder}/{name}"), key=_version)[::-1] for folder in folders]
    paths = [path for newest_first in found_in for path in newest_first]
    return next((path for path in paths if Path(path).is_file() and os.access(path, os.X_OK)), None)


def _version(path: str) -> list[int]:
    """The numbers in a path, by which the newest of several versions is known."""
    return [int(number) for number in re.findall(r"\d+", path)]


def required_tool(name: str) -> str:
    """As `tool`; raises LeftOut with how to get it."""
    found = tool(name)
    if found is None:
        raise LeftOut(f"There is no {name} here.", REMEDIES[name])
    return found


@dataclass(frozen=True)
class Ran:
    """What a tool wrote, whether it ended by itself, and how long that took."""

    text: str
    ended: bool
    seconds: float


def run_case(
    tool_command: Sequence[str], case: str, environment: Mapping[str, str], seconds: float
) -> Ran:
    """Run a case of `small_case` under a tool, which is ended after so many seconds."""
    command = [*tool_command, sys.executable, "-m", "benchmarks.gpu.small_case", case]
    start, ended = time.monotonic(), True
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
        )
        try:
            process.wait(max(0.0, seconds))
        except subprocess.TimeoutExpired:
            ended = False
            process.kill()
            process.wait(5)
        out.seek(0)
        text = out.read().decode(errors="replace")
    return Ran(text, ended, time.monotonic() - start)
