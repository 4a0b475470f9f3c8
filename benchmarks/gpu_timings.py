"""What `gpu_check.py` times on a GPU: rasterizer, kernels, training steps, rendering, gsplat."""

import importlib
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch
from gpu_lists import Launch, launches_seen_by
from gpu_sections import Finding, Place
from gpu_training import film, step_of
from rgbavatar_ns.bench.drawing import leaf_gaussians
from rgbavatar_ns.bench.utilisation import gpu_utilisation
from torch import Tensor

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.recorded_rendering import RecordedRendering
from rgbavatar_ns.avatar.training.loop import make_optimizer
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.bench.scenes import DEFAULT_COUNT, DEFAULT_SIZE_PX, ellipsoid_scene, on_device
from rgbavatar_ns.bench.timing import Spread, peak_growth_bytes
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize

BATCH, FRAMES = 10, 60

Draw = Callable[[GaussianSet], Tensor]


def gpu_times(call: Callable[[], Any], repetitions: int, warm_up: int = 3) -> Spread:
    """Times of a call on the GPU's stream, with the pauses in which the host is late."""
    for _ in range(warm_up):
        call()
    marks = []
    for _ in range(repetitions):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        call()
        end.record()
        marks.append((start, end))
    torch.cuda.synchronize()
    return Spread.of([1e-3 * start.elapsed_time(end) for start, end in marks])


def _said(spread: Spread) -> str:
    return f"{spread.median_ms:.3f} ms ({spread.lower_ms:.3f} - {spread.upper_ms:.3f})"


def _scene(place: Place) -> tuple[GaussianSet, PinholeCameras]:
    gaussians, cameras = ellipsoid_scene(DEFAULT_COUNT, DEFAULT_SIZE_PX, BATCH)
    return on_device(gaussians, place.device), on_device(cameras, place.device)


def _time_draw(place: Place, gaussians: GaussianSet, draw: Draw) -> dict[str, Any]:
    """Forward without gradients, forward and backward to all attributes, and the memory of that."""
    leaves = leaf_gaussians(gaussians)
    with torch.no_grad():
        image_grad = torch.randn_like(draw(leaves)) / DEFAULT_SIZE_PX**2

    @torch.no_grad()
    def forward() -> None:
        draw(leaves)

    def both() -> None:
        for leaf in vars(leaves).values():
            leaf.grad = None
        draw(leaves).backward(image_grad)

    repetitions = 10 if place.quick else 40
    return {
        "forward": gpu_times(forward, repetitions),
        "both": gpu_times(both, repetitions),
        "bytes": peak_growth_bytes(both, place.device),
    }


def rasterizer(place: Place) -> Finding:
    """The rasterizer alone on the common workload."""
    gaussians, cameras = _scene(place)
    times = _time_draw(place, gaussians, _ours(cameras))
    told = (
        f"{BATCH} x {DEFAULT_COUNT}: forward {_said(times['forward'])}, forward and backward "
        f"{_said(times['both'])}, {times['bytes'] / 2**20:.0f} MiB"
    )
    return Finding(True, told, times)


def _ours(cameras: PinholeCameras) -> Draw:
    return lambda leaves: rasterize(leaves, cameras, backend="cuda").image


def gsplat(place: Place) -> Finding:
    """gsplat's batched path on the same Gaussians, ours before and after it."""
    try:
        library: Any = importlib.import_module("gsplat")
    except ImportError as error:
        return Finding(None, f"gsplat cannot be imported: {error}")
    gaussians, cameras = _scene(place)
    matrix = torch.zeros(3, 3, device=place.device)
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
        return call(leaves, (BATCH,), slice(None))[:, 0]

    def one_by_one(leaves: GaussianSet) -> Tensor:
        return torch.cat([call(leaves, (), position) for position in range(BATCH)])

    paths: dict[str, Any] = {}
    ours = [_time_draw(place, gaussians, _ours(cameras))]
    for name, draw in {"batched": batched, "one by one": one_by_one}.items():
        try:
            with torch.no_grad():
                difference = (draw(gaussians) - _ours(cameras)(gaussians)).abs().mean()
            paths[name] = _time_draw(place, gaussians, draw) | {"difference": float(difference)}
        # Versions before 1.5 have no batches of Gaussians, and refuse them in many ways.
        except Exception as error:
            paths[name] = {"error": f"{type(error).__name__}: {error}"[:200]}
    ours.append(_time_draw(place, gaussians, _ours(cameras)))
    own_ms = statistics.mean(times["both"].median_ms for times in ours)
    measured = {n: p["both"].median_ms / own_ms for n, p in paths.items() if "both" in p}
    told = f"gsplat {library.__version__}, times ours: " + (
        ", ".join(f"{name} {ratio:.2f}" for name, ratio in measured.items())
        or "; ".join(path["error"] for path in paths.values())
    )
    figures = {"ours": ours, "paths": paths, "ratios": measured, "version": library.__version__}
    return Finding(True if measured else None, told, figures)


class _Training:
    """The workload of the goal: K = 20, 60,990 Gaussians, 512 x 512, ten images a step."""

    def __init__(self, place: Place, *, recorded: bool) -> None:
        head = HeadModel.embedded()
        config = AvatarConfig(num_bases=20, uv_resolution=256)
        avatar = Avatar(head, torch.zeros(head.num_identity), config)
        frames = film(avatar, FRAMES, DEFAULT_SIZE_PX, place, small=False)
        self.avatar = avatar.to(place.device)
        self._order = torch.Generator().manual_seed(0)
        self._background = random_backgrounds(0, BATCH)
        optimizer = make_optimizer(self.avatar)
        self._step = step_of(place, self.avatar, optimizer, frames, BATCH, recorded=recorded)
        self.frames = frames

    @property
    def skipped_steps(self) -> int | None:
        """Recorded steps that had no room."""
        return getattr(self._step, "skipped_steps", None)

    def step(self) -> None:
        """On frames drawn at random."""
        chosen = torch.randperm(FRAMES, generator=self._order)[:BATCH].tolist()
        self._step(chosen, self._background)


def kernels(place: Place) -> Finding:
    """Milliseconds of each kernel in a fused step, by events around each launch."""
    training, steps = _Training(place, recorded=False), 5 if place.quick else 20
    for _ in range(5):
        training.step()
    marks: list[list[tuple[str, torch.cuda.Event, torch.cuda.Event]]] = []

    def timed(launch: Launch, kernel: str, arguments: tuple, values: Any) -> None:
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        launch(kernel, *arguments, **values)
        end.record()
        marks[-1].append((kernel, start, end))

    with launches_seen_by(place, timed):
        for _ in range(steps):
            marks.append([])
            training.step()
    place.wait()
    by_kernel: dict[str, list[float]] = defaultdict(list)
    for step in marks:
        sums: dict[str, float] = defaultdict(float)
        for kernel, start, end in step:
            sums[kernel] += start.elapsed_time(end)
        for kernel, milliseconds in sums.items():
            by_kernel[kernel].append(milliseconds)
    medians = {kernel: statistics.median(values) for kernel, values in by_kernel.items()}
    ranked = sorted(medians.items(), key=lambda item: -item[1])
    told = f"together {sum(medians.values()):.3f} ms a step: "
    told += ", ".join(f"{kernel} {milliseconds:.3f}" for kernel, milliseconds in ranked)
    return Finding(True, told, {"median_ms": medians})


def steps(place: Place) -> Finding:
    """Images a second of the step, eager and recorded, and how busy the GPU is."""
    figures: dict[str, Any] = {}
    told = []
    for name, recorded, count in (("eager", False, 60), ("recorded", True, 600)):
        count = count // 6 if place.quick else count
        torch.cuda.reset_peak_memory_stats(place.device)
        training = _Training(place, recorded=recorded)
        for _ in range(10):
            training.step()
        place.wait()
        start = time.perf_counter()
        for _ in range(count):
            training.step()
        issued = time.perf_counter() - start
        place.wait()
        seconds = time.perf_counter() - start
        spread = gpu_times(training.step, min(count, 100))
        busy = gpu_utilisation(training.step, place.device)
        rate = count * BATCH / seconds
        figures[name] = {
            "images_per_second": rate,
            "step": spread,
            "host_ms_per_step": 1e3 * issued / count,
            "gpu_utilisation_percent": busy.percent,
            "gpu_utilisation_note": busy.note,
            "peak_bytes": torch.cuda.max_memory_allocated(place.device),
            "gaussians": training.avatar.num_gaussians,
            "skipped_steps": training.skipped_steps,
        }
        percent = "?" if busy.percent is None else f"{busy.percent:.0f}"
        told.append(
            f"{name} {rate:.0f} images/s, {_said(spread)} a step, host "
            f"{1e3 * issued / count:.2f} ms, GPU {percent} % busy, "
            f"{figures[name]['peak_bytes'] / 2**20:.0f} MiB"
        )
        del training
        torch.cuda.empty_cache()
    return Finding(True, "; ".join(told), figures)


@torch.no_grad()
def rendering(place: Place) -> Finding:
    """Frames a second from theta to the image, one at a time and by ten, recorded and not."""
    training, figures = _Training(place, recorded=False), {}
    avatar, frames = training.avatar, training.frames
    for size in (1, BATCH):
        parts = frames.theta.split(size)
        rounds = 2 if place.quick else max(2, 20 * size // BATCH)
        ways = {
            "eager": lambda theta: avatar.render(theta, frames.cameras, backend="cuda"),
            "recorded": RecordedRendering(avatar, parts[0], frames.cameras, backend="cuda"),
        }
        for name, draw in ways.items():
            for theta in parts[:5]:
                draw(theta)
            place.wait()
            start = time.perf_counter()
            for _ in range(rounds):
                for theta in parts:
                    draw(theta)
            place.wait()
            seconds = time.perf_counter() - start
            figures[f"{name}_frames_per_second_by_{size}"] = rounds * FRAMES / seconds
    one, ten = (figures[f"recorded_frames_per_second_by_{size}"] for size in (1, BATCH))
    return Finding(True, f"{one:.0f} frames/s one at a time, {ten:.0f} by ten", figures)
