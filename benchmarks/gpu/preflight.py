"""What a machine has of what the GPU needs, and what to do about the rest.

Of the standard library alone until a question needs more, so that it answers anywhere.
"""

import ctypes
import importlib
import importlib.metadata
import importlib.util
import itertools
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks.gpu.bare_driver import BareDriver, BareError, compiled, compiler_libraries
from benchmarks.gpu.rows import Figures, Rows, SectionEnded
from benchmarks.gpu.tools import REMEDIES, tool

_HERE = Path(__file__).parent
_KERNELS = _HERE.parents[1] / "rgbavatar_ns" / "kernels" / "cuda" / "source.py"
_PACKAGES = ("numpy", "scipy", "jaxtyping", "safetensors", "filelock", "setuptools")
_OLDEST = (7, 5)
_TILES = 10_000
_SMI_SECONDS = 15.0
_SMI_FACTS = (
    *("name", "driver_version", "memory.total", "memory.used", "utilization.gpu", "pstate"),
    *("clocks.sm", "clocks.max.sm", "clocks.mem", "temperature.gpu", "power.draw", "power.limit"),
    *("compute_mode", "mig.mode.current", "ecc.mode.current"),
)


class Missing(Exception):
    """What is not there, why, and what to do; what it is called where nothing goes without it."""

    def __init__(self, what: str | None, why: str, remedy: str) -> None:
        self.what, self.why, self.remedy = what, why, remedy
        super().__init__(f"{why} {remedy}")


def preflight(rows: Rows) -> None:
    """Ask for each thing by itself; the last row names what is missing."""
    missing: list[str] = []
    questions: dict[str, Callable[[], Figures]] = {
        "python": python,
        "driver": driver,
        "carried_kernel": carried_kernel,
        "compiled_kernel": compiled_kernel,
        "packages": packages,
        "bindings": bindings,
        "torch": torch,
        "machine": machine,
        "tools": tools,
        "nvidia_smi": nvidia_smi,  # of a broken driver it may hang
    }
    for name, question in questions.items():
        with suppress(SectionEnded), rows.row(name) as figures:
            try:
                figures |= question()
            except Missing as lack:
                figures |= {"failed": lack.why, "remedy": lack.remedy}
                if lack.what is not None and lack.what not in missing:
                    missing.append(lack.what)
    with rows.row("verdict") as figures:
        figures["missing"] = missing


def python() -> Figures:
    """The interpreter."""
    return {
        "version": platform.python_version(),
        "program": sys.executable,
        "system": f"{platform.system()} {platform.release()}",
        "cores": os.cpu_count(),
    }


def _driver(library: Any) -> BareDriver:
    try:
        return BareDriver(library)
    except OSError as error:
        raise Missing(
            "an NVIDIA driver",
            f"There is no driver: {error}.",
            "Install one (a package of your system); in a container start with --gpus all.",
        ) from error
    except BareError as error:
        raise Missing(
            "a working NVIDIA GPU",
            f"The driver does not start: {error}.",
            "See `nvidia-smi` and `dmesg`; after an update of the driver restart the machine; in a "
            "container start with --gpus all; empty CUDA_VISIBLE_DEVICES hides all GPUs.",
        ) from error


def driver(library: Any = None) -> Figures:
    """The driver's CUDA version and the GPUs that it sees."""
    found = _driver(library).facts()
    if not found["gpus"]:
        raise Missing("an NVIDIA GPU", "The driver sees no GPU.", "Unset CUDA_VISIBLE_DEVICES.")
    return found


def nvidia_smi() -> Figures:
    """Clocks, power, memory and modes of the first GPU, and who else uses it."""
    program = tool("nvidia-smi")
    if program is None:
        return {"absent": REMEDIES["nvidia-smi"]}

    def ask(what: str) -> list[str]:
        command = [program, what, "--format=csv,noheader,nounits"]
        try:
            ran = subprocess.run(command, capture_output=True, text=True, timeout=_SMI_SECONDS)
        except (OSError, subprocess.TimeoutExpired) as error:
            return [f"{type(error).__name__}: {error}"]
        return (ran.stdout if ran.returncode == 0 else ran.stdout + ran.stderr).splitlines()

    facts = ask("--query-gpu=" + ",".join(_SMI_FACTS))
    values = facts[0].split(", ") if facts else []
    if len(values) != len(_SMI_FACTS):
        return {"says": " ".join(facts)[:500]}
    others = ask("--query-compute-apps=pid,process_name,used_memory")
    return {**dict(zip(_SMI_FACTS, values)), "others_on_it": others}


def _sums_of(counts: list[int]) -> list[int]:
    return [0, *itertools.accumulate(counts)]


def _known_counts() -> list[int]:
    return [7919 * number % 13 for number in range(_TILES)]


def carried_kernel(library: Any = None) -> Figures:
    """A kernel from a text that lies beside this file, by the driver alone."""
    device, counts = _driver(library), _known_counts()
    device.enter()
    start = time.perf_counter()
    text, numbers = (_HERE / "exclusive_sums.ptx").read_bytes(), device.array(counts)
    starts = device.array([0] * (len(counts) + 1))
    places = ctypes.c_uint64(numbers), ctypes.c_uint64(starts), ctypes.c_int32(len(counts))
    device.start(text, "exclusive_sums", 1, *places)
    right = device.read(starts, len(counts) + 1) == _sums_of(counts)
    return _told(right, start)


def compiled_kernel(library: Any = None, compiler: Any = None) -> Figures:
    """Our `scan`, compiled with all kernels and started by the driver alone."""
    device, counts = _driver(library), _known_counts()
    device.enter()
    kernels, start = _kernel_sources(), time.perf_counter()
    compiler = _compiler() if compiler is None else compiler
    code = compiled(compiler, kernels.sources(), kernels.MAIN, device.architecture())
    seconds = time.perf_counter() - start
    scan = kernels.kernels()["scan"]
    total, arguments = sum(counts), scan.arguments()
    frame, bins = arguments.frame, arguments.bins
    frame.batch, frame.tiles_x, frame.tiles_y = 1, len(counts), 1
    # As many slots as entries have been taken; the number has 64 bits.
    named = kernels.constants()
    before = [0] * named["kStatusNumbers"]
    before[named["kSlotsTaken"]] = total
    after = list(before)
    after[named["kEntriesNeeded"]] = after[named["kSlotsNeeded"]] = total
    starts, status = device.array([0] * (len(counts) + 1)), device.array(before)
    bins.tile_count, bins.tile_start, bins.status = device.array(counts), starts, status
    bins.capacity = total
    device.start(code, "scan_kernel", scan.threads, arguments)
    right = device.read(starts, len(counts) + 1) == _sums_of(counts)
    right &= device.read(status, len(after)) == after
    return {"compile_s": seconds, "code_bytes": len(code), **_told(right, start)}


def _told(right: bool, start: float) -> Figures:
    figures: Figures = {"seconds": time.perf_counter() - start}
    if not right:
        figures |= {"failed": "its sums are wrong", "remedy": "Run the vendor's own diagnostics."}
    return figures


def _kernel_sources() -> Any:
    """Our module of kernels' sources, whose package imports torch."""
    spec = importlib.util.spec_from_file_location("kernel_sources", _KERNELS)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look for their module
    spec.loader.exec_module(module)
    return module


def _compiler() -> ctypes.CDLL:
    refusals = []
    for path in compiler_libraries():
        try:
            return ctypes.CDLL(path)
        except OSError as error:
            refusals.append(f"{path}: {error}")
    raise Missing(
        None,  # cuda-bindings may know where else to look
        "There is no run-time compiler: " + ("; ".join(refusals) or "libnvrtc is nowhere") + ".",
        "pip install nvidia-cuda-nvrtc (CUDA 12: nvidia-cuda-nvrtc-cu12).",
    )


def packages() -> Figures:
    """The versions of what our code imports."""
    found = {name: _version(name) for name in _PACKAGES}
    absent = [name for name, version in found.items() if version is None]
    if absent:
        what = ", ".join(absent)
        raise Missing(what, f"Not installed: {what}.", f"pip install {' '.join(absent)}.")
    return found


def bindings() -> Figures:
    """cuda-bindings, through which kernels are compiled and started."""
    try:
        driver_bindings = importlib.import_module("cuda.bindings.driver")
        nvrtc = importlib.import_module("cuda.bindings.nvrtc")
        versions = nvrtc.nvrtcVersion()[1:]
    # Where their library is missing or too old they raise errors of many kinds.
    except Exception as error:
        raise Missing(
            "cuda-bindings",
            f"cuda-bindings cannot be used: {type(error).__name__}: {error}.",
            "pip install cuda-bindings nvidia-cuda-nvrtc, both of torch's CUDA version.",
        ) from error
    place = getattr(driver_bindings, "__file__", None)
    nvrtc_version = ".".join(map(str, versions))
    return {"version": _version("cuda-bindings"), "place": place, "nvrtc": nvrtc_version}


def torch() -> Figures:
    """torch, its CUDA build, and whether it can use the GPU."""
    try:
        library: Any = importlib.import_module("torch")
    # A damaged installation raises more than ImportError.
    except Exception as error:
        raise Missing(
            "torch",
            f"torch cannot be imported: {type(error).__name__}: {error}.",
            "Install a CUDA build (pytorch.org/get-started).",
        ) from error
    found = {"version": library.__version__, "cuda": library.version.cuda}
    if library.version.cuda is None:
        raise Missing(
            "a CUDA build of torch",
            f"torch {library.__version__} is a build for CPUs.",
            "Install a CUDA build (pytorch.org/get-started) of the driver's CUDA version or older.",
        )
    if not library.cuda.is_available():
        raise Missing(
            "a GPU that torch can use",
            f"torch {library.__version__} for CUDA {library.version.cuda} sees no GPU.",
            "Compare the driver's CUDA version (the row `driver`) with torch's: update the driver "
            "or install an older CUDA build of torch.",
        )
    capability = library.cuda.get_device_capability()
    if capability < _OLDEST:
        raise Missing(
            "a GPU of sm_75 or newer",
            f"{library.cuda.get_device_name()} is sm_{capability[0]}{capability[1]}.",
            "Use another GPU.",
        )
    free, total = library.cuda.mem_get_info()
    return {
        **found,
        "gpu": library.cuda.get_device_name(),
        "architecture": f"sm_{capability[0]}{capability[1]}",
        "built_for": library.cuda.get_arch_list(),
        "free_mib": free >> 20,
        "total_mib": total >> 20,
    }


def machine() -> Figures:
    """The facts that every timing of ours comes with."""
    try:
        facts = importlib.import_module("rgbavatar_ns.bench.machine").machine_facts
    except ImportError as error:
        return {"absent": f"{type(error).__name__}: {error}"}
    return facts()


def tools() -> Figures:
    """Where the tools of the long checks are, or how to get them."""
    names = [name for name in REMEDIES if name != "nvidia-smi"]
    return {name: tool(name) or f"absent. {REMEDIES[name]}" for name in names}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
