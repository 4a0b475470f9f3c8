"""The rasterizer with every instruction set that this processor runs, by turns, on one thread.

    python benchmarks/speed/instruction_sets.py

The common workload (`rgbavatar bench rasterizer`); the least time of each, since whatever else runs
only adds to it, and how many times that of the fastest set it is.
"""

import argparse
import os
import time
from collections import defaultdict

import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

from rgbavatar_ns.bench.scenes import ellipsoid_scene, leaf_gaussians
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize
from rgbavatar_ns.kernels.cpu import INSTRUCTION_SET_VARIABLE
from rgbavatar_ns.kernels.cpu.backend import instruction_sets


def seconds(
    leaves: GaussianSet, cameras: PinholeCameras, image_grad: torch.Tensor
) -> tuple[float, float]:
    """Of a forward and of a backward pass of the batch, whose gradients are added to none."""
    for leaf in vars(leaves).values():
        leaf.grad = None
    begun = time.perf_counter()
    image = rasterize(leaves, cameras, backend="cpu").image
    drawn = time.perf_counter()
    image.backward(image_grad)
    return drawn - begun, time.perf_counter() - drawn


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--turns", type=int, default=25)
    parser.add_argument("--gaussians", type=int, default=60_000)
    parser.add_argument("--size-px", type=int, default=512)
    options = parser.parse_args()
    torch.set_num_threads(1)
    batch = 2
    gaussians, cameras = ellipsoid_scene(options.gaussians, options.size_px, batch)
    leaves = leaf_gaussians(gaussians)
    generator = torch.Generator().manual_seed(1)
    image_grad = torch.randn(batch, options.size_px, options.size_px, 3, generator=generator)
    image_grad /= options.size_px**2
    found = defaultdict(list)
    for _ in track(range(options.turns), "turns"):
        for name in instruction_sets():
            os.environ[INSTRUCTION_SET_VARIABLE] = name
            found[name].append(seconds(leaves, cameras, image_grad))
    least = {name: [min(times) / batch for times in zip(*turns)] for name, turns in found.items()}
    fastest = least[instruction_sets()[0]]
    table = Table("instruction set", "forward, ms an image", "backward", "times the fastest's")
    for name, times in least.items():
        ratios = " / ".join(f"{a / b:.2f}" for a, b in zip(times, fastest))
        table.add_row(name, *(f"{1e3 * t:.1f}" for t in times), ratios)
    Console().print(table)


if __name__ == "__main__":
    main()
