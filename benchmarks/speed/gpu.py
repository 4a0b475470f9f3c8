"""Times on an NVIDIA GPU: rasterizer, kernels, training steps, rendering, gsplat beside them.

    python benchmarks/speed/gpu.py --budget 300 --json gpu.json

Run it from a checkout; `python -m pytest -m cuda tests` says whether what is timed is right. It
needs torch, numpy, scipy, cuda-bindings, nvidia-cuda-nvrtc, jaxtyping and safetensors; neither
nerfstudio nor a network. First it draws and trains once: a failure there ends it. Each row is
printed and the JSON written anew as soon as it is there, so that an end loses nothing.
"""

import argparse
import faulthandler
import importlib
import json
import statistics
import sys
import time
import types
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
try:
    import roma  # noqa: F401
except ModuleNotFoundError:
    # The head's module of rotations imports it, for conversions that nothing here asks for.
    sys.modules["roma"] = types.ModuleType("roma")

import torch
from torch import Tensor
from torch.utils.benchmark import Measurement, Timer

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.recorded_rendering import RecordedRendering
from rgbavatar_ns.avatar.training import TrainingOptions, TrainingStep
from rgbavatar_ns.avatar.training.batches import ChosenFrames, DeviceFrames
from rgbavatar_ns.avatar.training.cuda_graph import Recorder, record_cuda_graph
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.bench.machine import machine_facts
from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.roofline import measure_speed, rasterizer_work, roofline_figures
from rgbavatar_ns.bench.scenes import ellipsoid_scene, front_camera, leaf_gaussians, on_device
from rgbavatar_ns.bench.timing import peak_growth_bytes
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize
from rgbavatar_ns.kernels.registry import choose

Figures = dict[str, Any]
Draw = Callable[[GaussianSet], Tensor]


@dataclass(frozen=True)
class Workload:
    """What is timed, where, and for how many seconds each time."""

    device: torch.device
    seconds: float
    recorder: Recorder = record_cuda_graph
    gaussians: int = 60_000
    size_px: int = 512
    batch: int = 10
    frames: int = 60
    uv_resolution: int = 256

    def scene(self) -> tuple[GaussianSet, PinholeCameras]:
        """The common workload of the rasterizer."""
        gaussians, cameras = ellipsoid_scene(self.gaussians, self.size_px, self.batch)
        return on_device(gaussians, self.device), on_device(cameras, self.device)

    def time(self, call: Callable[[], Any]) -> Measurement:
        """Repeat the call; what the device still has to do is waited for after each block."""
        timer = Timer("call()", globals={"call": call})
        return timer.blocked_autorange(min_run_time=self.seconds)

    def figures(self, call: Callable[[], Any]) -> Figures:
        """Milliseconds of a call."""
        found = self.time(call)
        return {"median_ms": 1e3 * found.median, "iqr_ms": 1e3 * found.iqr}


class Training:
    """An avatar with K = 20 and the frames that it is trained on, in either way."""

    def __init__(self, work: Workload) -> None:
        head = HeadModel.embedded()
        config = AvatarConfig(num_bases=20, uv_resolution=work.uv_resolution)
        avatar = Avatar(head, torch.zeros(head.num_identity), config)
        cameras = on_device(front_camera(avatar, work.size_px), work.device)
        generator = torch.Generator().manual_seed(0)
        theta = 0.05 * torch.randn(work.frames, avatar.layout.size, generator=generator)
        self.avatar, self._work = avatar.to(work.device), work
        theta = theta.to(work.device)
        with torch.no_grad():
            drawn = [self.avatar.render(part, cameras) for part in theta.split(work.batch)]
        # The frames show other colours than the avatar has, so that there is something to learn.
        for color in self.avatar.parameter_groups()["color"]:
            color.data += torch.rand(color.shape, generator=generator).to(color) - 0.5
        rgba = torch.cat([torch.cat([d.image, d.alpha], -1) for d in drawn])
        images = (255 * rgba.clamp(0, 1)).round().to(torch.uint8)
        self.frames = DeviceFrames(theta, cameras, images)
        self._order = torch.Generator().manual_seed(0)
        self._background = random_backgrounds(0, work.batch)
        self._options = TrainingOptions(first_colors=None, surface_prior=False, backend="cuda")

    def fused(self) -> Callable[[], object]:
        """A step kernel by kernel, on frames drawn at random."""
        take = TrainingStep(self.avatar, options=self._options)

        def step() -> object:
            batch = self.frames.batch(self._chosen())
            return take(replace(batch, background=self._background), 0)

        return step

    def recorded(self) -> Callable[[], object]:
        """The same as one CUDA graph."""
        take = TrainingStep(
            self.avatar,
            options=self._options,
            frames=lambda: self.frames,
            recorder=self._work.recorder,
        )
        for _ in range(5):
            take(ChosenFrames(self._chosen(), self._background), 0)
        return lambda: take(ChosenFrames(self._chosen(), self._background), 0)

    def _chosen(self) -> list[int]:
        work = self._work
        return torch.randperm(work.frames, generator=self._order)[: work.batch].tolist()


def smoke(work: Workload) -> Figures:
    """A small drawing against the reference, with gradients; and how long its first use takes."""
    gaussians, cameras = ellipsoid_scene(300, 48, 2)
    leaves, start = leaf_gaussians(on_device(gaussians, work.device)), time.perf_counter()
    image = rasterize(leaves, on_device(cameras, work.device), backend="cuda").image
    image.square().sum().backward()
    drawn = image.detach().cpu()
    seconds = time.perf_counter() - start
    expected = rasterize(gaussians, cameras, backend="reference").image
    difference = float((drawn - expected).abs().max())
    finite = all(
        bool(torch.as_tensor(leaf.grad).isfinite().all()) for leaf in vars(leaves).values()
    )
    if difference > 2 / 255 or not finite:
        raise RuntimeError(f"differs from the reference by {difference:.4f}, finite: {finite}")
    return {"first_use_s": seconds, "largest_difference": difference}


def rasterizer(work: Workload) -> Figures:
    """Forward without gradients, forward and backward to all attributes; memory, roofline."""
    gaussians, cameras = work.scene()
    found = time_draw(work, gaussians, ours(cameras))
    pairs, speed = count_pairs(gaussians, cameras), measure_speed(work.device)
    both = rasterizer_work(pairs, gaussians, cameras, backward=True)
    reached_ms = found["both"]["median_ms"] / work.batch
    least = roofline_figures([both], speed, work.batch, reached_ms, pairs / work.batch)
    return found | {"roofline": least}


def ours(cameras: PinholeCameras) -> Draw:
    """Our kernels."""
    return lambda gaussians: rasterize(gaussians, cameras, backend="cuda").image


def time_draw(work: Workload, gaussians: GaussianSet, draw: Draw) -> Figures:
    """Times of a batch, and the memory of forward and backward."""
    leaves = leaf_gaussians(gaussians)
    with torch.no_grad():
        image_grad = torch.randn_like(draw(leaves)) / work.size_px**2

    def both() -> None:
        for leaf in vars(leaves).values():
            leaf.grad = None
        draw(leaves).backward(image_grad)

    return {
        "forward": work.figures(lambda: torch.no_grad()(draw)(gaussians)),
        "both": work.figures(both),
        "bytes": peak_growth_bytes(both, work.device),
    }


def kernels(work: Workload) -> Figures:
    """Milliseconds of each kernel in a fused step, by events around each launch."""
    take = Training(work).fused()
    for _ in range(5):
        take()
    launcher = choose("cuda", work.device, torch.float32).launcher(work.device)  # pyright: ignore
    launch, marks = launcher.launch, []

    def timed(kernel: str, *arguments: Any, **values: Any) -> None:
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        launch(kernel, *arguments, **values)
        end.record()
        marks[-1].append((kernel, start, end))

    launcher.launch = timed
    try:
        for _ in range(20):
            marks.append([])
            take()
    finally:
        del launcher.launch
    torch.cuda.synchronize()
    by_kernel: dict[str, list[float]] = defaultdict(list)
    for step in marks:
        sums: dict[str, float] = defaultdict(float)
        for kernel, start, end in step:
            sums[kernel] += start.elapsed_time(end)
        for kernel, milliseconds in sums.items():
            by_kernel[kernel].append(milliseconds)
    return {f"{kernel}_ms": statistics.median(values) for kernel, values in by_kernel.items()}


def steps(work: Workload) -> Figures:
    """Images a second of a whole step, kernel by kernel and as one CUDA graph."""
    figures: Figures = {"gaussians": Training(work).avatar.num_gaussians}
    for name in ("fused", "recorded"):
        take = getattr(Training(work), name)()
        found = work.time(take)
        figures[f"{name}_images_per_second"] = work.batch / found.median
        figures[f"{name}_ms"] = 1e3 * found.median
    return figures


@torch.no_grad()
def rendering(work: Workload) -> Figures:
    """Frames a second from theta to the image, one at a time and by ten, recorded and not."""
    training, figures = Training(work), {}
    avatar, cameras = training.avatar, training.frames.cameras
    for size in (1, work.batch):
        theta = training.frames.theta[:size]
        recorded = RecordedRendering(avatar, theta, cameras, backend="cuda", recorder=work.recorder)
        ways = {
            "fused": lambda theta=theta: avatar.render(theta, cameras, backend="cuda"),
            "recorded": lambda theta=theta, draw=recorded: draw(theta),
        }
        for name, draw in ways.items():
            figures[f"{name}_frames_per_second_by_{size}"] = size / work.time(draw).median
    return figures


def gsplat(work: Workload) -> Figures:
    """gsplat's kernels on the same Gaussians: its times over ours, measured before and after."""
    library: Any = importlib.import_module("gsplat")
    gaussians, cameras = work.scene()
    matrix = torch.zeros(3, 3, device=work.device)
    matrix[0, 0], matrix[1, 1] = cameras.focal_px[0]
    matrix[0, 2], matrix[1, 2] = cameras.principal_point_px[0]
    matrix[2, 2] = 1

    def call(leaves: GaussianSet, lead: tuple[int, ...], part: Any) -> Tensor:
        return library.rasterization(
            *(getattr(leaves, name)[part] for name in vars(leaves)),
            viewmats=cameras.world_to_camera[0].expand(*lead, 1, 4, 4),
            Ks=matrix.expand(*lead, 1, 3, 3),
            width=cameras.width,
            height=cameras.height,
            packed=False,
        )[0]

    def batched(leaves: GaussianSet) -> Tensor:
        return call(leaves, (work.batch,), slice(None))[:, 0]

    def one_by_one(leaves: GaussianSet) -> Tensor:
        return torch.cat([call(leaves, (), position) for position in range(work.batch)])

    figures: Figures = {"version": library.__version__}
    before = time_draw(work, gaussians, ours(cameras))
    for name, draw in {"batched": batched, "one by one": one_by_one}.items():
        try:
            with torch.no_grad():
                difference = (draw(gaussians) - ours(cameras)(gaussians)).abs().mean()
            figures[name] = time_draw(work, gaussians, draw) | {"difference": float(difference)}
        # Versions before 1.5 have no batches of Gaussians, and refuse them in many ways.
        except Exception as error:
            figures[name] = {"unavailable": f"{type(error).__name__}: {error}"[:200]}
    after = time_draw(work, gaussians, ours(cameras))
    for figure in ("forward", "both"):
        own = statistics.mean(found[figure]["median_ms"] for found in (before, after))
        for name in ("batched", "one by one"):
            if figure in figures[name]:
                figures[name][f"{figure}_over_ours"] = figures[name][figure]["median_ms"] / own
    return figures


ROWS: tuple[Callable[[Workload], Figures], ...] = (
    *(smoke, rasterizer, steps, kernels, rendering),
    gsplat,
)


def measure(work: Workload, budget_s: float, path: Path | None) -> int:
    """Print and write row after row; 1 where one has failed."""
    start, failed, rows = time.monotonic(), False, {}
    for row in ROWS:
        name = row.__name__
        if time.monotonic() - start > budget_s:
            rows[name] = {"left_out": f"the budget of {budget_s:g} s is spent"}
        else:
            try:
                rows[name] = row(work)
            except ModuleNotFoundError as error:
                rows[name] = {"left_out": str(error)}
            # Whatever a kernel or a library may raise: the rows before it are kept.
            except Exception as error:
                rows[name], failed = {"failed": f"{type(error).__name__}: {error}"}, True
        print(f"{name}: {json.dumps(rows[name])}", flush=True)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"machine": machine_facts(), "rows": rows}, indent=2))
        if name == "smoke" and failed:
            break
    return int(failed)


def main(arguments: Sequence[str] | None = None) -> int:
    """Time all rows; 1 where one fails or there is no GPU."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--budget", type=float, default=300.0, help="seconds in all, about")
    parser.add_argument("--json", type=Path, help="also write all figures here")
    options = parser.parse_args(arguments)
    if not torch.cuda.is_available():
        print("torch sees no NVIDIA GPU, which is what is to be timed.", file=sys.stderr)
        return 1
    # A kernel that never ends holds Python too: then this ends it, with what is written so far.
    faulthandler.dump_traceback_later(options.budget + 60, exit=True)
    device = torch.device("cuda", torch.cuda.current_device())
    return measure(Workload(device, options.budget / 40), options.budget, options.json)


if __name__ == "__main__":
    sys.exit(main())
