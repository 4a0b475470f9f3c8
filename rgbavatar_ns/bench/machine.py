"""The facts that a timing depends on."""

import os
import platform
import subprocess
import time
from pathlib import Path
from typing import Any

import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import available_backends, unavailable_backends


def machine_facts() -> dict[str, Any]:
    """Processor, instruction set of the rasterizer, versions, threads, load, commit and date."""
    return {
        "processor": _processor(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "threads": torch.get_num_threads(),
        "instruction_set": _instruction_set(),
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "commit": _commit(),
        "date": time.strftime("%Y-%m-%d %H:%M"),
    }


def chosen_device(name: str | None, backend: str = "auto") -> torch.device:
    """The device to measure on: the one named, else the GPU where this backend can use it.

    Raises UserError where the GPU is named and cannot be used, or another one than the backend's.
    """
    reason = unavailable_backends().get("cuda")
    if name is None:
        name = "cuda" if reason is None and backend in ("auto", "cuda") else "cpu"
    if name == "cuda" and reason is not None:
        raise UserError(
            f"There is no GPU to measure on: {reason}.", "Leave out --device, or pass --device cpu."
        )
    if backend in ("cpu", "cuda") and backend != name:
        raise UserError(
            f"The rasterizer's backend {backend!r} does not draw on the device {name!r}.",
            f"Pass --device {backend}, or another --backend.",
        )
    return torch.device(name)


def require_backend(name: str, device: torch.device) -> str:
    """The backend that `name` stands for on a device; raises UserError where it cannot be used."""
    available = available_backends()
    if name == "auto":
        name = device.type
    if name not in available:
        raise UserError(
            f"The rasterizer's backend {name!r} cannot be used here (available: "
            f"{', '.join(available)}).",
            "Install the package again with a C++17 compiler (make setup); `rgbavatar bench "
            "rasterizer --backend reference --count 500 --size 64` measures the slow reference.",
        )
    return name


def _processor() -> str:
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.exists():
        for line in cpu_info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _instruction_set() -> str | None:
    """The copy of the compiled loops that is used; None without a compiled backend."""
    try:
        from rgbavatar_ns.kernels.cpu.backend import INSTRUCTION_SET_VARIABLE, instruction_sets
    except ImportError:
        return None
    return os.environ.get(INSTRUCTION_SET_VARIABLE) or instruction_sets()[0]


def _commit() -> str | None:
    """The commit of the checkout that is imported, "-dirty" with changes; None elsewhere."""
    here = Path(__file__).resolve().parent
    try:
        if _git(here, "ls-files", "--error-unmatch", Path(__file__).name).returncode != 0:
            return None
        return _git(here, "describe", "--always", "--dirty", "--exclude", "*").stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _git(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        ["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10
    )
