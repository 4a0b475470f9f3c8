"""Memory of a rendering and its gradients, measured from outside."""

import subprocess
import sys
from pathlib import Path

import pytest

from rgbavatar_ns.kernels import available_backends

BATCH, LIMIT_MB = 10, 40

# 60,000 Gaussians on an ellipsoid that fills most of 512 x 512, a few pixels large. The high-water
# mark is of this process's own memory; getrusage's would be at least the parent's.
PROGRAM = f"""
import torch

from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize


def resident_mb(which):
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(which)) / 1024


def scene(count, size):
    direction = torch.nn.functional.normalize(torch.randn({BATCH}, count, 3), dim=-1)
    attributes = GaussianSet(
        direction * torch.tensor([0.085, 0.115, 0.1]),
        torch.randn({BATCH}, count, 4),
        torch.rand({BATCH}, count, 3) * 1e-3 + 1e-4,
        torch.rand({BATCH}, count) * 0.85 + 0.1,
        torch.rand({BATCH}, count, 3),
    )
    for value in vars(attributes).values():
        value.requires_grad_()
    world_to_camera = torch.eye(4)[None].clone()
    world_to_camera[0, 2, 3] = 1
    half = torch.full((1, 2), size / 2)
    return attributes, PinholeCameras(world_to_camera, half * 8.8, half, size, size)


def draw(attributes, cameras):
    rendered = rasterize(attributes, cameras, backend="cpu")
    rendered.image.sum().backward()


torch.set_num_threads(2)
draw(*scene(100, 16))
inputs = scene(60_000, 512)
before = resident_mb("VmRSS")
draw(*inputs)
print((resident_mb("VmHWM") - before) / {BATCH})
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
@pytest.mark.skipif("cpu" not in available_backends(), reason="the extension is not compiled")
def test_an_image_and_its_gradients_take_less_than_40_mb():
    output = subprocess.check_output([sys.executable, "-c", PROGRAM], text=True, timeout=120)
    growth_mb = float(output)
    # Outputs and gradients alone are 8 MB.
    assert 8 < growth_mb < LIMIT_MB
