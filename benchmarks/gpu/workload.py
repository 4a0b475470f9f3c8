"""What is timed: common sizes, and an avatar with the frames that it is trained on."""

import itertools
import sys
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

try:
    import roma  # noqa: F401
except ModuleNotFoundError:
    # The head's module of rotations imports it, for conversions that nothing here asks for.
    sys.modules["roma"] = types.ModuleType("roma")

import torch
from torch import Tensor
from torch.utils.benchmark import Measurement, Timer

from benchmarks.gpu.rows import Figures
from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.training import TrainingOptions, TrainingStep
from rgbavatar_ns.avatar.training.batches import ChosenFrames, DeviceFrames
from rgbavatar_ns.avatar.training.cuda_graph import Recorder, record_cuda_graph
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.bench.scenes import close_camera, ellipsoid_scene, on_device
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.kernels.cuda.launcher import Launcher
from rgbavatar_ns.kernels.registry import choose

Step = Callable[[], Mapping[str, Tensor]]
"""Takes a training step and gives the parts of its loss."""

_LARGER, _FAINTER = 300.0, 0.2
"""Of a head-sized ellipsoid's Gaussians, so that one fills the picture and hides nothing."""

WARM_UP_STEPS = 6
"""Steps until one is recorded and has been repeated."""


@dataclass(frozen=True)
class Workload:
    """Sizes, by default the paper's; where they are drawn; how long and how often they are timed.

    Attributes:
        seconds: for a timing; `run_seconds` for a whole training.
        calls: steps that are looked at one by one, or timed together.
    """

    device: torch.device
    seconds: float = 1.5
    run_seconds: float = 25.0
    calls: int = 20
    recorder: Recorder = record_cuda_graph
    gaussians: int = 60_000
    size_px: int = 512
    batch: int = 10
    frames: int = 60
    uv_resolution: int = 256
    crowd: int = 8_000
    screen_filling: int = 0

    @classmethod
    def here(cls) -> "Workload":
        """That of the current GPU."""
        return cls(torch.device("cuda", torch.cuda.current_device()))

    def small(self) -> "Workload":
        """A case that a tool which slows everything down gets through."""
        most = {"gaussians": 300, "size_px": 48, "batch": 2, "frames": 4, "uv_resolution": 12}
        return replace(
            self, **{name: min(getattr(self, name), size) for name, size in most.items()}
        )

    def crowded(self) -> "Workload":
        """One picture with long lists, and with Gaussians that fill it."""
        size_px = min(self.size_px, 32)
        return replace(self, gaussians=self.crowd, size_px=size_px, batch=1, screen_filling=4)

    @property
    def on_gpu(self) -> bool:
        """False on what stands for one."""
        return self.device.type == "cuda"

    def wait(self) -> None:
        """Until the device has done what it was given."""
        if self.on_gpu:
            torch.cuda.synchronize(self.device)

    def launcher(self) -> Launcher:
        """What starts the backend's kernels, compiled where they were not."""
        backend: Any = choose("cuda", self.device, torch.float32)
        return backend.launcher(self.device)

    def scene(self) -> tuple[GaussianSet, PinholeCameras]:
        """The rasterizer's common workload, the first Gaussians made large and faint."""
        gaussians, cameras = ellipsoid_scene(self.gaussians, self.size_px, self.batch)
        gaussians.scales[:, : self.screen_filling] *= _LARGER
        gaussians.opacities[:, : self.screen_filling] *= _FAINTER
        return on_device(gaussians, self.device), on_device(cameras, self.device)

    def time(self, call: Callable[[], Any]) -> Measurement:
        """Repeat the call; what the device still has to do is waited for after so many `calls`.

        As in training, where the host runs ahead: after each step it would be waited for too long.
        """
        # By itself the timer leaves the host one thread.
        timer = Timer("call()", globals={"call": call}, num_threads=torch.get_num_threads())
        blocks = [timer.timeit(self.calls)]  # a warm-up is torch's own
        while sum(block.times[0] for block in blocks) * self.calls < self.seconds:
            blocks.append(timer.timeit(self.calls))
        return Measurement.merge(blocks)[0]

    def figures(self, call: Callable[[], Any]) -> Figures:
        """Milliseconds of a call."""
        found = self.time(call)
        return {"median_ms": 1e3 * found.median, "iqr_ms": 1e3 * found.iqr}


BARE = TrainingOptions(first_colors=None, surface_prior=False, backend="cuda")
"""A step and nothing beside it."""


_STIRRED = {
    "position": 4e-3,
    "rotation": 0.8,
    "log_scale": 0.4,
    "opacity": 1.0,
    "color": 1.0,
    "basis_position": 2e-3,
    "basis_rotation": 0.4,
    "basis_color": 0.2,
    "weight_network": 0.04,
}
"""How widely each group's parameters are moved, so that every gradient is more than rounding."""


class Training:
    """An avatar with K = 20 and frames of what it was before it was stirred, always the same."""

    def __init__(self, work: Workload) -> None:
        head = HeadModel.embedded()
        config = AvatarConfig(num_bases=20, uv_resolution=work.uv_resolution)
        generator = torch.Generator().manual_seed(0)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # the weight network's first weights
            avatar = Avatar(head, torch.zeros(head.num_identity), config)
        cameras = on_device(close_camera(avatar, work.size_px), work.device)
        theta = 0.05 * torch.randn(work.frames, avatar.layout.size, generator=generator)
        self.avatar, self.work = avatar.to(work.device), work
        theta = theta.to(work.device)
        with torch.no_grad():
            drawn = [self.avatar.render(part, cameras) for part in theta.split(work.batch)]
        for name, parameters in self.avatar.parameter_groups().items():
            for parameter in parameters:
                noise = torch.rand(parameter.shape, generator=generator) - 0.5
                parameter.data += _STIRRED[name] * noise.to(parameter)
        rgba = torch.cat([torch.cat([d.image, d.alpha], -1) for d in drawn])
        images = (255 * rgba.clamp(0, 1)).round().to(torch.uint8)
        self.frames = DeviceFrames(theta, cameras, images)
        self.background = random_backgrounds(0, work.batch)
        self._order = torch.Generator().manual_seed(0)

    def rows(self) -> list[int]:
        """The next frames, drawn at random."""
        work = self.work
        return torch.randperm(work.frames, generator=self._order)[: work.batch].tolist()

    def fused(self) -> Step:
        """A step kernel by kernel, on batches that lie ready: choosing them would wait."""
        take = TrainingStep(self.avatar, options=BARE)
        background = self.background.to(self.work.device)
        batches = itertools.cycle(
            [replace(self.frames.batch(self.rows()), background=background) for _ in range(4)]
        )
        return lambda: take(next(batches), 0)

    def unrecorded(self, options: TrainingOptions = BARE) -> TrainingStep:
        """A step on all frames, which becomes one CUDA graph after its first calls."""
        return TrainingStep(
            self.avatar,
            options=options,
            frames=lambda: self.frames,
            recorder=self.work.recorder,
        )

    def recorded(self) -> Step:
        """A step as one CUDA graph, which has been repeated already."""
        take = self.unrecorded()

        def step() -> Mapping[str, Tensor]:
            return take(ChosenFrames(self.rows(), self.background), 0)

        for _ in range(WARM_UP_STEPS):
            step()
        return step
