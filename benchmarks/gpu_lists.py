"""What `gpu_check.py` asks of the tiles' lists: that every kernel sees the same ones.

Which tiles a Gaussian touches is decided anew by the kernels that count, scatter and sum. A
compiler may round in another way in each; a tile that one counts and another leaves out would be a
hole in a list or in the sums. Holes are made visible: sums that are not written are NaN.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from gpu_sections import Finding, Place
from gpu_training import small_avatar, small_frames, step_of
from rgbavatar_ns.bench.drawing import leaf_gaussians
from torch import Tensor

from rgbavatar_ns.avatar.training.loop import make_optimizer
from rgbavatar_ns.bench.scenes import ellipsoid_scene, on_device
from rgbavatar_ns.kernels import rasterize

Launch = Callable[..., None]
Seen = Callable[[Launch, str, tuple, Any], None]


@contextmanager
def launches_seen_by(place: Place, seen: Seen) -> Iterator[None]:
    """Hand every launch of the backend to `seen`, which starts it."""
    launcher = place.backend.launcher(place.device)
    launch = launcher.launch
    launcher.launch = lambda kernel, *arguments, **values: seen(launch, kernel, arguments, values)
    try:
        yield
    finally:
        del launcher.launch


def lists(place: Place) -> Finding:
    """Lists without holes, sorted, and sums without holes, of the rasterizer and of steps."""
    counts = {"lists": 0, "holes": 0, "out of order": 0, "sums with holes": 0}

    def seen(launch: Launch, kernel: str, arguments: tuple, values: Any) -> None:
        if "slots" in values and kernel in ("train", "differentiate", "average"):
            values["slots"].fill_(torch.nan)
        launch(kernel, *arguments, **values)
        if kernel == "sort":
            bins = values["bins"]
            counts["lists"] += len(bins["tile_count"])
            counts["holes"] += int((bins["tile_count"] != 0).sum())
            counts["out of order"] += _out_of_order(bins["tile_start"], bins["entries"])
        if kernel in ("project_backward", "blend_backward", "collect"):
            values.pop("slots")
            sums = [value for value in values.values() if isinstance(value, Tensor)]
            counts["sums with holes"] += sum(int(torch.isnan(value).sum()) for value in sums)

    seeds = 1 if place.emulated else (3 if place.quick else 10)
    size = (300, 48, 2) if place.emulated else (60_000, 512, 10)
    with launches_seen_by(place, seen):
        for seed in range(seeds):
            gaussians, cameras = ellipsoid_scene(*size, seed=seed)
            leaves = leaf_gaussians(on_device(gaussians, place.device))
            drawn = rasterize(
                leaves, on_device(cameras, place.device), backend="cuda", with_visibility=True
            )
            drawn.image.square().sum().backward()
        avatar = small_avatar().to(place.device)
        frames, background = small_frames(place, 3)
        step = step_of(place, avatar, make_optimizer(avatar), frames, 3, recorded=False)
        for _ in range(2 * seeds):
            step([0, 1, 2], background)
    wrong = [name for name in counts if name != "lists" and counts[name]]
    told = ", ".join(f"{count} {name}" for name, count in counts.items())
    return Finding(not wrong and counts["lists"] > 0, told, counts)


def _out_of_order(starts: Tensor, entries: Tensor) -> int:
    """Neighbours in a list of which the first lies behind; depths are positive, so bits sort."""
    length = int(starts[-1])
    descends = entries[1:length] < entries[: length - 1]
    begins = torch.zeros(length + 1, dtype=torch.bool, device=entries.device)
    begins[starts.long().clamp(max=length)] = True
    return int((descends & ~begins[1:length]).sum())
