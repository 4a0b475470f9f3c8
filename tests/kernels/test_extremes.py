"""Gaussians that are hard to draw, by every instruction set, against the float64 reference."""

import functools
import math

import pytest
import torch
from torch import Tensor

from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.kernels.constants import MAX_ALPHA, MIN_ALPHA, NEAR_PLANE_M
from tests.kernels.agreement import assert_agrees, expect
from tests.kernels.scenes import ATTRIBUTES, Scene, changed, random_scene, to

WIDTH, HEIGHT, FOCAL = 45, 38, 40.0


def _camera(width: int = WIDTH, height: int = HEIGHT) -> PinholeCameras:
    """At the origin, along +z; its axis meets the centre of a pixel."""
    return PinholeCameras(
        torch.eye(4, dtype=torch.float64)[None],
        torch.full((1, 2), FOCAL, dtype=torch.float64),
        torch.tensor([[width // 2 + 0.5, height // 2 + 0.5]], dtype=torch.float64),
        width,
        height,
    )


def _scene(means, scales, opacities, quats=None, colors=None, camera=None, seed: int = 0) -> Scene:
    """One set of Gaussians from rows; values are those of float32, so that all draw the same."""
    generator = torch.Generator().manual_seed(seed)

    def random(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, dtype=torch.float64)

    means = torch.as_tensor(means, dtype=torch.float64).reshape(-1, 3)
    count = len(means)
    camera = camera or _camera()
    size = (1, camera.height, camera.width)
    rows = {
        "means": means,
        "quats_wxyz": random(count, 4) - 0.5 if quats is None else quats,
        "scales": torch.as_tensor(scales, dtype=torch.float64).expand(count, 3),
        "opacities": torch.as_tensor(opacities, dtype=torch.float64).expand(count),
        "colors": random(count, 3) if colors is None else colors,
    }
    gaussians = GaussianSet(**{name: row[None] for name, row in rows.items()})
    gaussians = to(to(gaussians, torch.float32), torch.float64)
    return Scene(gaussians, camera, random(3), random(*size, 3) - 0.5, random(*size, 1) - 0.5)


def _at_pixels(x, y, depth_m) -> Tensor:
    """Means whose images lie `x`, `y` pixels from the camera's axis."""
    x, y, depth_m = (torch.as_tensor(value, dtype=torch.float64) for value in (x, y, depth_m))
    x, y, depth_m = torch.broadcast_tensors(x, y, depth_m)
    return torch.stack([x * depth_m / FOCAL, y * depth_m / FOCAL, depth_m], -1)


def _uniform(low: float, high: float, count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)


def _joined(*scenes: Scene) -> Scene:
    parts = {name: [getattr(each.gaussians, name) for each in scenes] for name in ATTRIBUTES}
    return changed(scenes[0], **{name: torch.cat(rows, 1) for name, rows in parts.items()})


def _spread(right_px: float, down_px: float, count: int, seed: int) -> Tensor:
    """Means on both sides of the camera's axis, up to so many pixels from it."""
    return _at_pixels(
        _uniform(-right_px, right_px, count, seed),
        _uniform(-down_px, down_px, count, seed + 1),
        _uniform(1.5, 3.0, count, seed + 2),
    )


def _ordinary(count: int, seed: int) -> Scene:
    means = _spread(24, 20, count, seed)
    scales = torch.stack([_uniform(0.02, 0.2, count, seed + k) for k in (3, 4, 5)], -1)
    return _scene(means, scales, _uniform(0.1, 0.9, count, seed + 6), seed=seed)


def _huge() -> Scene:
    one = _scene([[0.1, -0.2, 2.0]], [300.0, 700.0, 500.0], 0.6)
    return _joined(one, _ordinary(30, seed=10))


def _needles() -> Scene:
    count = 16
    angle = math.pi / 4 + torch.linspace(-0.05, 0.05, count).double()
    angle[8:] += math.pi / 2
    quats = torch.stack([(angle / 2).cos(), 0 * angle, 0 * angle, (angle / 2).sin()], -1)
    means = _at_pixels(_uniform(-15, 15, count, 1), _uniform(-15, 15, count, 2), 2.0)
    means[:, 2] += torch.linspace(0, 0.01, count)
    return _scene(means, [0.7, 1e-7, 1e-7], 0.9, quats)


def _stacked() -> Scene:
    count = 3000
    means = _spread(0.3, 0.3, count, seed=1)
    scales = torch.stack([_uniform(0.01, 0.06, count, k) for k in (3, 4, 5)], -1)
    return _scene(means, scales, _uniform(0.004, 0.03, count, 6), camera=_camera(9, 7))


def _opacities() -> Scene:
    values = [1.0, 1 - 1e-6, MAX_ALPHA * 1.00002, MAX_ALPHA, MAX_ALPHA * 0.99998, 0.5]
    values += [MIN_ALPHA * factor for factor in (0.5, 0.998, 1.002, 1.02, 2.0)]
    x = torch.arange(len(values)) * 4.0 - 20
    front = _scene(_at_pixels(x, 0.0, 2.0), 0.05, torch.tensor(values), seed=1)
    behind = _scene(_at_pixels(x, 0.3, 2.5), 0.1, 0.7, seed=2)
    return _joined(front, behind)


def _scattered(scales: Tensor, seed: int) -> Scene:
    count = len(scales)
    return _scene(_spread(20, 15, count, seed), scales, _uniform(0.1, 0.3, count, seed + 3))


def _scales() -> Scene:
    values = [0.0, 1e-20, 1e-30, 1e-40, 1e-10, 1e-3, 1.0, 1e3, 1e6]
    equal = torch.tensor(values, dtype=torch.float64)[:, None].expand(-1, 3)
    thin = torch.tensor([[0.05, size, other] for size in values[:6] for other in values[:6]])
    return _joined(_scattered(equal, 1), _scattered(thin, 5), _ordinary(10, seed=20))


def _endless_needles() -> Scene:
    lengths = torch.tensor([[0.0, 0.05, 1e3], [1e-20, 0.05, 3e2], [1.0, 1e-30, 1e3]])
    return _joined(_scattered(lengths, 3), _ordinary(10, seed=20))


def _near_plane() -> Scene:
    depths = NEAR_PLANE_M * torch.tensor([0.5, 0.9999, 1.0001, 1.5, 3.0]).double()
    depths = torch.cat([depths, torch.tensor([0.0, -0.01, -2.0]).double()])
    on_axis = _scene(_at_pixels(torch.arange(8.0) * 3 - 12, 2.0, depths), 2e-4, 0.6, seed=1)
    # Beside the camera: their images lie far outside, but they reach into it.
    beside = torch.tensor([[0.3, 0.0, NEAR_PLANE_M * 1.001], [0.0, -0.3, 0.02], [-0.2, 0.2, 0.05]])
    return _joined(on_axis, _scene(beside, 0.15, 0.5, seed=2), _ordinary(12, seed=30))


def _opaque() -> Scene:
    x, y = torch.meshgrid(torch.arange(-26.0, 27, 6), torch.arange(-22.0, 23, 6), indexing="ij")
    layers = [
        _scene(_at_pixels(x.reshape(-1), y.reshape(-1), depth), 0.5, opacity, seed=k)
        for k, (depth, opacity) in enumerate([(1.0, 1.0), (1.1, 0.97), (1.2, 1.0), (1.3, 0.98)])
    ]
    return _joined(*layers, _ordinary(200, seed=40))


def _half_opaque() -> Scene:
    """Walls that end inside of tiles and of blocks, with much behind."""
    depths = torch.linspace(1.0, 1.3, 12)
    wall = _scene(_at_pixels(-14.0, -11.0, depths), [0.25, 0.2, 0.3], 1.0)
    return _joined(wall, _ordinary(150, seed=50))


def _strong_colors() -> Scene:
    scene = _ordinary(60, seed=60)
    colors = scene.gaussians.colors
    colors[:, ::3] *= -30
    colors[:, 1::3] *= 50
    return scene


SCENES = {
    "one covers everything": _huge,
    "needles at 45 degrees": _needles,
    "3000 on one pixel": _stacked,
    "opacities at the cut and the cap": _opacities,
    "scales from 0 to 1e6": _scales,
    "needles without an end": _endless_needles,
    "around the near plane": _near_plane,
    "opaque early": _opaque,
    "opaque in parts": _half_opaque,
    "strong colours": _strong_colors,
}
TOLERANCES = {
    # A needle's exponent is the difference of numbers up to (its length in px)^2, and its scale's
    # gradient a difference of (length / width)^2 times as much: float32 has no more digits.
    "needles at 45 degrees": {"value_error": 4e-4, "gradient_error": 1e-2},
    "needles without an end": {
        "value_error": 5e-3,
        "gradient_error": 1e-2,
        "attributes": ("opacities", "colors", "background"),
    },
    "strong colours": {"value_error": 3e-3},  # the image's values are as much larger
}


@functools.cache
def _expected(name: str):
    return expect(SCENES[name]())


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.usefixtures("instruction_set")
def test_hard_scenes_match_reference(name):
    assert_agrees(_expected(name), "cpu", **TOLERANCES.get(name, {}))


def test_hard_scenes_are_what_they_are_called():
    alpha = {name: _expected(name).rendered.alpha for name in SCENES}
    assert alpha["one covers everything"].min() > 0.59
    assert alpha["3000 on one pixel"].max() > 0.9998
    assert (alpha["opaque early"] > 0.9999).double().mean() > 0.95
    assert 0.1 < (alpha["opaque in parts"] > 0.9999).double().mean() < 0.6
    needles = (alpha["needles at 45 degrees"] > 0).double().mean()
    assert 0.1 < needles < 0.9


SIDES = [(1, 1), (1, 7), (7, 1), (2, 3), (4, 4), (5, 4), (63, 65), (65, 63), (64, 64), (1, 131)]


@functools.cache
def _of_size(width: int, height: int):
    return expect(
        random_scene(7, batch=1, count=40, width=width, height=height, extremes=False), 0.4
    )


@pytest.mark.parametrize(("width", "height"), [*SIDES, (131, 2)])
@pytest.mark.usefixtures("instruction_set")
def test_small_and_odd_sizes_match_reference(width, height):
    assert_agrees(_of_size(width, height), "cpu")
