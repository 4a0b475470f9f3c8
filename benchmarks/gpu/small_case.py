"""What NVIDIA's tools look at: every kernel once or twice, in a process that they start.

python -m benchmarks.gpu.small_case fused|recorded|profiled
"""

import sys
from dataclasses import replace

import torch

from benchmarks.gpu.workload import Training, Workload
from rgbavatar_ns.bench.scenes import leaf_gaussians
from rgbavatar_ns.kernels import rasterize, weighted_color_average

DONE = "small case: done"
"""Its last word: a tool may say that all is well of a program that it never ran."""


def fused(work: Workload) -> None:
    """Pictures with gradients, averages, and steps kernel by kernel."""
    for case in (work.small(), work.crowded()):
        gaussians, cameras = case.scene()
        leaves = leaf_gaussians(gaussians)
        drawn = rasterize(leaves, cameras, backend="cuda", with_depth=True, with_visibility=True)
        (drawn.image.square().sum() + drawn.alpha.sum()).backward()
        weighted_color_average(gaussians, cameras, drawn.image.detach(), backend="cuda")
    step = Training(work.small()).fused()
    for _ in range(2):
        step()


def recorded(work: Workload) -> None:
    """Steps as one CUDA graph."""
    step = Training(work.small()).recorded()
    for _ in range(2):
        step()


def profiled(work: Workload) -> None:
    """A step of the whole size, alone between the profiler's start and stop."""
    step = Training(work).fused()
    for _ in range(3):
        step()
    work.wait()
    if work.on_gpu:
        torch.cuda.profiler.start()
    step()
    work.wait()
    if work.on_gpu:
        torch.cuda.profiler.stop()


CASES = {case.__name__: case for case in (fused, recorded, profiled)}


def main(name: str, work: Workload) -> None:
    """Run a case, and say so."""
    CASES[name](replace(work, frames=work.batch))
    work.wait()
    print(DONE, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Workload.here())
