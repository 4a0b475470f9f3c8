"""Short takes with random theta, cameras whose numbers have no short form, and noise images."""

from pathlib import Path

import numpy as np
import torch

from rgbavatar_ns.head.flame import load_flame
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.synthetic.exporters import Take, TakeFrame

WIDTH, HEIGHT = 24, 18
NUM_FRAMES, NUM_TEST = 6, 2
FIRST = 3
"""Number of the first frame: clips seldom begin at zero."""


def make_take(flame: Path, version: str, stiff_neck: bool) -> tuple[Take, list[TakeFrame]]:
    arrays = load_flame(flame, version=version, teeth=False)
    generator = np.random.default_rng(int(version))
    identity = np.zeros(300)
    identity[:100] = 0.5 * generator.standard_normal(100)
    own = identity.astype(np.float32).astype(float)
    take = Take(arrays, own, NUM_FRAMES, NUM_TEST, WIDTH, HEIGHT, "data")
    return take, [make_frame(FIRST + k, generator, stiff_neck) for k in range(NUM_FRAMES)]


def make_frame(index: int, generator: np.random.Generator, stiff_neck: bool) -> TakeFrame:
    turns = {
        name: generator.uniform(-0.4, 0.4, 3)
        for name in ("rotation", "neck", "jaw", "left_eye", "right_eye")
    }
    if stiff_neck:
        turns["neck"] = np.zeros(3)
    theta = {
        **turns,
        "expression": generator.standard_normal(100) * 0.4,
        "translation": generator.uniform(-0.05, 0.05, 3),
        "eyelids": generator.uniform(0, 1, 2) if stiff_neck else np.zeros(2),
    }
    camera = PinholeCameras(
        torch.tensor(
            [[[1.0, 0, 0, 1 / 70], [0, -1, 0, 1 / 30], [0, 0, -1, 1 + 1 / 7], [0, 0, 0, 1]]]
        ),
        torch.tensor([[100 / 3, 320 / 9]]),
        torch.tensor([[WIDTH / 2 + 1 / 9, HEIGHT / 2 - 1 / 7]]),
        WIDTH,
        HEIGHT,
    )
    return TakeFrame(index, theta, camera, _picture(index))


def _picture(index: int) -> np.ndarray:
    """Smooth, so that JPEG keeps it; soft alpha at an edge."""
    x, y = np.meshgrid(np.linspace(0, 1, WIDTH), np.linspace(0, 1, HEIGHT))
    color = np.stack([x, y, (x + y) / 2, np.clip(2 * y - 0.3, 0, 1)], -1) * (255 - 6 * index)
    return color.round().astype(np.uint8)
