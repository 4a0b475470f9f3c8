"""The C++ loops on an emulated ARM processor, in place of the compiled module's sessions."""

import functools
import hashlib
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rgbavatar_ns.kernels.cpu import backend

COMPILER, PROCESSOR = "aarch64-linux-gnu-g++", "qemu-aarch64"
_KERNELS = Path(backend.__file__).parent / "src"
_SHARED = _KERNELS.parents[1] / "shared"
_MAIN = Path(__file__).with_name("session.cpp")
_SOURCES = ("raster.cpp", "sorting.cpp", "instruction_sets.cpp")
_FLAGS = ("-std=c++17", "-O2", "-static", "-pthread", "-fno-math-errno", "-fno-trapping-math")


def missing() -> str | None:
    """Which of the programs that this needs is not installed."""
    return next((name for name in (COMPILER, PROCESSOR) if shutil.which(name) is None), None)


@functools.cache
def program() -> Path:
    """The compiled program, made once for these sources."""
    texts = [path.read_bytes() for path in sorted(_KERNELS.iterdir()) + sorted(_SHARED.iterdir())]
    name = hashlib.sha256(b"\0".join([*texts, _MAIN.read_bytes()])).hexdigest()[:16]
    path = Path(tempfile.gettempdir()) / f"rgbavatar_neon_{name}"
    if not path.exists():
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            built = Path(folder) / "session"
            command = [COMPILER, *_FLAGS, "-ffp-contract=fast", "-DRGBAVATAR_ISA=generic"]
            command += [f"-I{_KERNELS}", f"-I{_SHARED}", str(_MAIN)]
            command += [str(_KERNELS / name) for name in (*_SOURCES, "isa_kernels.cpp")]
            subprocess.run([*command, "-o", str(built)], check=True)
            built.rename(path)
    return path


@dataclass
class EmulatedSession:
    """As the compiled module's: what it is given goes to the program, what comes back is copied."""

    gaussians: tuple[Tensor, ...]
    world_to_camera: Tensor
    focal_px: Tensor
    principal_point_px: Tensor
    batch: int
    width: int
    height: int
    threads: int
    instruction_set: str

    def draw(
        self, background: Tensor, first: int, image: Tensor, alpha: Tensor, depth: Tensor | None
    ) -> None:
        assert first == 0
        assert len(image) == self.batch
        self._call("draw", [background], [image, alpha, depth])

    def average(
        self,
        images: Tensor | None,
        weighted_sum: Tensor | None,
        weight_sum: Tensor | None,
        max_weight: Tensor,
    ) -> None:
        count = self.batch * self.gaussians[0].shape[1]
        places = [weighted_sum, weight_sum, max_weight]
        channels = 0 if images is None else images.shape[-1]
        self._call("average", [images], places, [count * channels, count, count])

    def backward(
        self,
        gaussians: tuple[Tensor, ...],
        background: Tensor,
        image_grad: Tensor | None,
        alpha_grad: Tensor | None,
        threads: int,
        *filled: Tensor,
    ) -> None:
        self.gaussians = gaussians
        self._call("backward", [background, image_grad, alpha_grad], list(filled))

    def _call(
        self,
        name: str,
        given: list[Tensor | None],
        places: list[Any],
        lengths: list[int] | None = None,
    ) -> None:
        offset = [None] * (6 - len(self.gaussians))
        arrays = [*self.gaussians, *offset, self.world_to_camera, self.focal_px]
        arrays += [self.principal_point_px, *given, *[None] * (3 - len(given))]
        count = self.gaussians[0].shape[1]
        sizes = np.array([self.batch, count, self.width, self.height, self.threads], np.int32)
        with tempfile.TemporaryDirectory() as folder:
            into, out = Path(folder) / "in", Path(folder) / "out"
            into.write_bytes(sizes.tobytes() + b"".join(map(_record, arrays)))
            subprocess.run([PROCESSOR, str(program()), name, str(into), str(out)], check=True)
            found = torch.from_numpy(np.fromfile(out, np.float32))
        if lengths is None:
            pixels = self.batch * self.width * self.height
            lengths = [pixels if place is None else place.numel() for place in places]
        for place, part in zip(places, found.split(lengths)):
            if place is not None:
                place.copy_(part.view_as(place))


def _record(tensor: Tensor | None) -> bytes:
    if tensor is None:
        return np.zeros(2, np.int32).tobytes()
    header = np.array([len(tensor), tensor.numel()], np.int32)
    return header.tobytes() + tensor.detach().contiguous().numpy().tobytes()


def install(monkeypatch) -> None:
    """Make the backend "cpu" that of an emulated ARM processor."""
    module = SimpleNamespace(Session=EmulatedSession, Gaussians=lambda *tensors: tensors)
    monkeypatch.setattr(backend, "_native", module)
