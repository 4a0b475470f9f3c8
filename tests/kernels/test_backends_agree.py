"""Every float32 backend against the float64 reference: values and gradients."""

import functools

import pytest
import torch

from rgbavatar_ns.kernels import available_backends
from tests.kernels.agreement import assert_agrees, expect
from tests.kernels.scenes import random_scene, render_and_differentiate

SCENES = {
    "plain": {"extremes": False},
    "extremes": {},
    "cameras": {"num_cameras": 3},
    "cameras of one set": {"batch": 1, "num_cameras": 2},
    "shared scales and opacities": {"shared": ("scales", "opacities")},
    "one means": {"shared": ("means",)},
    "ten cameras": {"batch": 10, "num_cameras": 10, "count": 70, "width": 18, "height": 13},
    "one of ten cameras": {"batch": 1, "num_cameras": 10, "count": 70, "width": 18, "height": 13},
    "one Gaussian": {"count": 1, "width": 18, "height": 13},
    "all shared but means": {"shared": ("quats_wxyz", "scales", "opacities", "colors")},
    "one pixel": {"width": 1, "height": 1},
    "several tiles": {"width": 131, "height": 66, "batch": 1, "count": 120},
    "crowded": {"count": 700, "batch": 1, "width": 16, "height": 12},
}


@functools.cache
def _expected(name: str):
    return expect(random_scene(5, **SCENES[name]))


@pytest.mark.parametrize("name", SCENES)
def test_values_and_gradients_match_reference(fast_backend, name):
    assert_agrees(_expected(name), fast_backend)


def test_extreme_scenes_are_seen_at_all():
    scene = random_scene(5)
    rendered, grads = render_and_differentiate(scene, torch.float64, "reference")
    assert 0.05 < rendered.alpha.mean() < 1
    assert all(grad.norm() > 0 for grad in grads.values())


def test_no_gaussians_show_the_background(fast_backend):
    scene = random_scene(0, count=0)
    rendered, grads = render_and_differentiate(scene, torch.float32, fast_backend)
    expected = scene.background.float().double().expand_as(rendered.image)
    torch.testing.assert_close(rendered.image, expected)
    assert rendered.alpha.max() == 0
    assert grads["means"].shape == (3, 0, 3)


@pytest.mark.skipif("cpu" not in available_backends(), reason="the extension is not compiled")
def test_compiled_constants_are_the_reference_s():
    from rgbavatar_ns.kernels import constants
    from rgbavatar_ns.kernels.cpu.backend import compiled_constants

    compiled = compiled_constants()
    names = {name for name in vars(constants) if name.isupper()}
    assert names == set(compiled)
    for name, value in compiled.items():
        assert value == pytest.approx(getattr(constants, name), rel=1e-6)
