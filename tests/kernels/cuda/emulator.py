"""The CUDA backend on a processor: its own kernels and its own Python, another launcher.

`load` makes it a backend for CPU tensors, so that whatever is asked of backends can be asked of it.
"""

import ctypes
import functools
import hashlib
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rgbavatar_ns.kernels import registry
from rgbavatar_ns.kernels.cuda import source
from rgbavatar_ns.kernels.cuda.arguments import fill
from rgbavatar_ns.kernels.cuda.backend import CudaBackend
from rgbavatar_ns.kernels.cuda.launcher import Launcher

_EMULATION = Path(__file__).with_name("emulation.cpp")


def compiler() -> str | None:
    """A C++ compiler that makes the emulation; it leans on Linux."""
    return shutil.which("g++")


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled emulation, made once for these sources."""
    name = source.source_hash() + hashlib.sha256(_EMULATION.read_bytes()).hexdigest()[:8]
    path = Path(tempfile.gettempdir()) / f"rgbavatar_emulation_{name}.so"
    if not path.exists():
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            for file, text in source.sources().items():
                (Path(folder) / file).write_text(text)
            built = Path(folder) / "emulation.so"
            command = ["g++", "-std=c++17", "-O2", "-fPIC", "-shared", "-U_FORTIFY_SOURCE"]
            # Out of bounds, overflow and the like end the process.
            command += ["-fsanitize=undefined", "-fsanitize-undefined-trap-on-error"]
            command += ["-fno-sanitize=vptr", f"-I{folder}", str(_EMULATION), "-o", str(built)]
            subprocess.run(command, check=True)
            built.rename(path)
    return ctypes.CDLL(str(path))


class EmulatedLauncher:
    """Runs a kernel's blocks one after the other, their threads in an order by `seed`."""

    device = torch.device("cpu")

    def __init__(self) -> None:
        self.seed, self.launched, self.pending = 0, [], False

    def launch(
        self, kernel: str, grid: Sequence[int], shared_bytes: int = 0, **values: Any
    ) -> None:
        known = source.kernels()[kernel]
        arguments = fill(known.arguments.__name__, values, self.device)
        assert shared_bytes <= 96 << 10, "more than every GPU of sm_75 or newer has"
        self.launched.append(kernel)
        run = getattr(library(), f"{kernel}_emulated")
        run(ctypes.byref(arguments), grid[0], grid[1], known.threads, self.seed)

    def read_later(self, numbers: Tensor) -> Callable[[], list[int] | None]:
        values = numbers.tolist()
        return lambda: None if self.pending else values

    def capturing(self) -> bool:
        return False


class EmulatedBackend(CudaBackend):
    """Takes what a GPU's backend takes, in main memory."""

    def __init__(self) -> None:
        super().__init__()
        self.emulated = EmulatedLauncher()

    def launcher(self, device: torch.device) -> Launcher:
        return self.emulated

    def unsupported_reason(self, device: torch.device, dtype: torch.dtype) -> str | None:
        return None if dtype == torch.float32 else "it takes float32 tensors"


def load() -> EmulatedBackend:
    """As `rgbavatar_ns.kernels.cuda.backend.load`."""
    return EmulatedBackend()


def install(monkeypatch) -> EmulatedBackend:
    """Make it the backend "cuda" for a test."""
    backend = load()
    real = registry._load
    monkeypatch.setattr(registry, "_load", lambda name: backend if name == "cuda" else real(name))
    return backend
