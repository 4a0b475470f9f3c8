"""Gaussians that are not numbers harm nobody else; arguments that do not fit are refused."""

import math
import warnings

import pytest
import torch

from rgbavatar_ns.kernels import (
    GaussianSet,
    available_backends,
    rasterize,
    registry,
    weighted_color_average,
)
from tests.kernels.scenes import (
    ATTRIBUTES,
    changed,
    in_float32,
    random_scene,
    render_and_differentiate,
    to,
)

DTYPES = {"reference": torch.float64, "cpu": torch.float32}


@pytest.mark.parametrize("backend", available_backends())
@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, value) for name in ATTRIBUTES for value in (math.nan, math.inf, -math.inf)),
        ("quats_wxyz", 0.0),
        ("quats_wxyz", 1e-20),
        ("quats_wxyz", 1e200),
        ("scales", 1e200),
    ],
)
def test_degenerate_gaussians_contribute_nothing(backend, name, value):
    scene = random_scene(0, count=60, batch=1, width=9, height=10, extremes=False)
    broken, absent = getattr(scene.gaussians, name).clone(), scene.gaussians.opacities.clone()
    broken[:, 7], absent[:, 7] = value, 0
    (rendered, grads), (expected, expected_grads) = (
        render_and_differentiate(each, DTYPES[backend], backend)
        for each in (changed(scene, **{name: broken}), changed(scene, opacities=absent))
    )
    assert torch.equal(rendered.image, expected.image)
    for attribute in ATTRIBUTES:
        assert torch.equal(grads[attribute], expected_grads[attribute])
        assert (grads[attribute][:, 7] == 0).all()


def _small():
    return in_float32(random_scene(0, count=4, extremes=False))


def _replaced(value, **changes):
    # Without the constructor: run-time shape checks would speak before the code under test.
    copy = object.__new__(type(value))
    for name, old in vars(value).items():
        object.__setattr__(copy, name, changes.get(name, old))
    return copy


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        (0, {"means": torch.zeros(4, 3)}, r"means are \[4, 3\]. Pass \[B or 1, N, 3\]"),
        (0, {"scales": torch.ones(1, 5, 3)}, r"scales are \[1, 5, 3\]. Pass \[B or 1, 4, 3\]"),
        (0, {"colors": torch.ones(2, 4, 3)}, "colors: leading dimension 2 in a batch of 3"),
        (0, {"opacities": torch.ones(1, 4).double()}, "opacities: torch.float64"),
        (0, {"means": torch.zeros(1, 4, 3, dtype=torch.int64)}, "floating-point"),
        (1, {"focal_px": torch.tensor([[-1.0, 1.0]])}, "must be positive"),
        (1, {"focal_px": torch.ones(2, 2)}, r"focal_px is \[2, 2\]"),
        (1, {"world_to_camera": torch.full((1, 4, 4), math.nan)}, "NaN or infinity"),
        (1, {"width": 0}, "width is 0"),
    ],
)
def test_gaussians_and_cameras_that_do_not_fit_are_refused(part, changes, message):
    drawn = list(_small())
    drawn[part] = _replaced(drawn[part], **changes)
    with pytest.raises(ValueError, match=message):
        rasterize(*drawn)


def test_other_arguments_that_do_not_fit_are_refused():
    gaussians, cameras = _small()
    with pytest.raises(ValueError, match="no backend 'quick'"):
        rasterize(gaussians, cameras, backend="quick")
    with pytest.raises(ValueError, match="leading dimension 2 in a batch of 3"):
        rasterize(gaussians, cameras, torch.zeros(2, 3))
    nine_channels = torch.zeros(3, cameras.height, cameras.width, 9)
    with pytest.raises(ValueError, match="9 channels"):
        weighted_color_average(gaussians, cameras, nine_channels)
    with pytest.raises(ValueError, match=r"Pass \[B, H, W, C\]"):
        weighted_color_average(gaussians, cameras, torch.zeros(3, 4, 4, 3))


@pytest.mark.parametrize("backend", available_backends())
def test_an_empty_batch_is_refused(backend):
    """Compiled loops would read the first set, which is not there."""
    gaussians, cameras = _small()
    none = GaussianSet(**{name: tensor[:0] for name, tensor in vars(gaussians).items()})
    images = torch.zeros(0, cameras.height, cameras.width, 3)
    for given, name in (
        ((none, cameras), "means"),
        ((gaussians, cameras.select([])), "cameras"),
        ((none, cameras.select([])), "means"),
        ((_replaced(gaussians, opacities=gaussians.opacities[:0]), cameras), "opacities"),
    ):
        with pytest.raises(ValueError, match=f"{name}: leading dimension 0. Pass at least 1"):
            rasterize(*given, backend=backend)
        with pytest.raises(ValueError, match=f"{name}: leading dimension 0. Pass at least 1"):
            weighted_color_average(*given, images, backend=backend)
    with pytest.raises(ValueError, match="background: leading dimension 0"):
        rasterize(gaussians, cameras, torch.zeros(0, 3), backend=backend)
    with pytest.raises(ValueError, match="images: leading dimension 0"):
        weighted_color_average(gaussians, cameras, images, backend=backend)


@pytest.mark.skipif("cpu" not in available_backends(), reason="the extension is not compiled")
def test_the_compiled_backend_says_what_it_takes(monkeypatch):
    gaussians, cameras = _small()
    with pytest.raises(ValueError, match="float32 tensors on the CPU"):
        rasterize(to(gaussians, torch.float64), to(cameras, torch.float64), backend="cpu")
    monkeypatch.setenv("RGBAVATAR_INSTRUCTION_SET", "mmx")
    with pytest.raises(ValueError, match="'mmx'"):
        rasterize(gaussians, cameras, backend="cpu")


def test_bindings_are_asked_for_in_the_version_of_torchs_cuda(monkeypatch):
    registry._warn_of_slow_choice.cache_clear()
    monkeypatch.setattr(torch.version, "cuda", "12.6")
    with pytest.warns(RuntimeWarning, match=r'pip install "cuda-bindings==12\.\*"'):
        registry._warn_of_slow_choice("cuda", "No module named 'cuda'")


def test_without_the_extension_the_reference_draws_and_the_reason_is_told(monkeypatch):
    load = registry._load

    def load_without_extension(name):
        return ImportError("No module named '_native'") if name == "cpu" else load(name)

    monkeypatch.setattr(registry, "_load", load_without_extension)
    registry._warn_of_slow_choice.cache_clear()
    gaussians, cameras = _small()
    with pytest.warns(RuntimeWarning, match="No module named '_native'"):
        rendered = rasterize(gaussians, cameras)
    assert torch.equal(rendered.image, rasterize(gaussians, cameras, backend="reference").image)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it is told once
        rasterize(gaussians, cameras)
    with pytest.raises(ValueError, match="No module named '_native'"):
        rasterize(gaussians, cameras, backend="cpu")
