"""Time the rasterizer: forward, and forward with backward, in milliseconds an image.

    python benchmarks/rasterizer.py --count 60000 --size 512 --batch 10 --threads 1

The workload: Gaussians on an ellipsoid that fills about 60 % of the image, anisotropic, mean
3-sigma radii of 5.4 and 3.0 pixels at 512 x 512, opacity U(.1, .95), a different set for every
image, one camera, gradients to all attributes. `--shared` shares opacities and scales within the
batch, as an avatar does. Medians over the repetitions.
"""

import json
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro

from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize


@dataclass
class Workload:
    """What is rendered, and how often."""

    count: int = 60_000
    """Gaussians in a set."""
    size: int = 512
    """Side of the images in pixels."""
    batch: int = 10
    """Sets, and images, at a time."""
    threads: int = 1
    repetitions: int = 7
    backend: str = "auto"
    shared: bool = False
    """Share opacities and scales within the batch."""
    json_path: Path | None = None
    """Also write the result here."""


def ellipsoid_scene(workload: Workload, seed: int = 0) -> tuple[GaussianSet, PinholeCameras]:
    """The common workload's Gaussians and camera."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *size: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*size, generator=generator)

    batch, count = workload.batch, workload.count
    direction = torch.randn(batch, count, 3, generator=generator)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    means = direction * torch.tensor([0.085, 0.115, 0.1])
    leading = 1 if workload.shared else batch
    # One pixel at 512 x 512 is 0.44 mm at the head's distance.
    scales = torch.stack(
        [uniform(0.5e-3, 1.3e-3, leading, count), uniform(0.3e-3, 0.8e-3, leading, count)], -1
    )
    scales = torch.cat([scales, uniform(0.1e-3, 0.25e-3, leading, count, 1)], -1)
    gaussians = GaussianSet(
        means,
        torch.randn(batch, count, 4, generator=generator),
        scales,
        uniform(0.1, 0.95, leading, count),
        uniform(0.0, 1.0, batch, count, 3),
    )
    world_to_camera = torch.eye(4)[None].clone()
    world_to_camera[0, 2, 3] = 1.0
    focal = 4.4 * workload.size * torch.ones(1, 2)
    cameras = PinholeCameras(
        world_to_camera,
        focal,
        torch.full((1, 2), workload.size / 2),
        workload.size,
        workload.size,
    )
    return gaussians, cameras


def _median_ms(run: Callable[[], float], repetitions: int) -> float:
    run()
    return 1e3 * statistics.median(run() for _ in range(repetitions))


def measure(workload: Workload) -> dict[str, float]:
    """Milliseconds an image, forward alone and with backward."""
    torch.set_num_threads(workload.threads)
    gaussians, cameras = ellipsoid_scene(workload)
    leaves = GaussianSet(**{k: v.requires_grad_() for k, v in vars(gaussians).items()})
    generator = torch.Generator().manual_seed(1)
    size = (workload.batch, workload.size, workload.size, 3)
    image_grad = torch.randn(size, generator=generator) / workload.size**2

    def forward() -> float:
        with torch.no_grad():
            start = time.perf_counter()
            rasterize(leaves, cameras, backend=workload.backend)
            return time.perf_counter() - start

    def both() -> float:
        for leaf in vars(leaves).values():
            leaf.grad = None
        start = time.perf_counter()
        rasterize(leaves, cameras, backend=workload.backend).image.backward(image_grad)
        return time.perf_counter() - start

    per_image = 1 / workload.batch
    return {
        "forward_ms": per_image * _median_ms(forward, workload.repetitions),
        "forward_backward_ms": per_image * _median_ms(both, workload.repetitions),
    }


def machine() -> dict[str, str]:
    """The facts that a timing depends on."""
    model = platform.processor() or platform.machine()
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.exists():
        lines = cpu_info.read_text().splitlines()
        model = next((line.split(":")[1].strip() for line in lines if "model name" in line), model)
    here = Path(__file__).parent
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=here, capture_output=True, text=True
    ).stdout.strip()
    try:
        from rgbavatar_ns.kernels.cpu.backend import instruction_sets

        names = " ".join(instruction_sets())
    except ImportError:
        names = "none: the extension is not compiled"
    return {
        "processor": model,
        "instruction_sets": names,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "commit": commit,
        "date": time.strftime("%Y-%m-%d"),
    }


def main() -> None:
    """Measure, print, and write JSON if asked."""
    workload = tyro.cli(Workload, description=__doc__)
    result = {"workload": asdict(workload), "machine": machine(), "result": measure(workload)}
    print(json.dumps(result, indent=2, default=str))
    if workload.json_path:
        workload.json_path.write_text(json.dumps(result, indent=2, default=str))


if __name__ == "__main__":
    main()
