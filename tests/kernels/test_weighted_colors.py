"""The weighted colour average against the reference and values worked by hand."""

import pytest
import torch

from rgbavatar_ns.kernels import (
    GaussianSet,
    PinholeCameras,
    available_backends,
    rasterize,
    weighted_color_average,
)
from tests.kernels.scenes import in_float32, random_scene, settled_pixels

DTYPES = {"reference": torch.float64, "cpu": torch.float32}


@pytest.mark.parametrize("channels", [1, 3, 4, 8])
@pytest.mark.parametrize("shared_image", [False, True])
def test_matches_reference(fast_backend, channels, shared_image):
    scene = random_scene(1, width=70, height=37, count=80)
    generator = torch.Generator().manual_seed(0)
    size = (1 if shared_image else 3, 37, 70, channels)
    images = torch.rand(size, generator=generator, dtype=torch.float64)
    expected = weighted_color_average(scene.gaussians, scene.cameras, images, backend="reference")
    got = weighted_color_average(*in_float32(scene), images.float(), backend=fast_backend)
    # Every pixel that rounding may cut adds at most the cut.
    slack = 1e-4 * expected.weight_sum + (~settled_pixels(scene)).sum() / 255 + 1e-5
    assert ((got.weight_sum - expected.weight_sum).abs() <= slack).all()
    assert ((got.weighted_sum - expected.weighted_sum).abs() <= slack[..., None]).all()
    assert (got.max_weight - expected.max_weight).abs().max() < 1 / 255 + 1e-4


@pytest.mark.parametrize("backend", available_backends())
def test_two_walls_by_hand(backend):
    # Two flat walls cover 2 x 2 pixels: weights .25 in front and .75 * .5 behind.
    dtype = DTYPES[backend]
    gaussians = GaussianSet(
        torch.tensor([[[0.0, 0.0, 4.0], [0.0, 0.0, 2.0]]], dtype=dtype),
        torch.tensor([[[1.0, 0.0, 0.0, 0.0]] * 2], dtype=dtype),
        torch.full((1, 2, 3), 1e4, dtype=dtype),
        torch.tensor([[0.5, 0.25]], dtype=dtype),
        torch.zeros(1, 2, 3, dtype=dtype),
    )
    ones = torch.ones(1, 2, dtype=dtype)
    cameras = PinholeCameras(torch.eye(4, dtype=dtype)[None], 2 * ones, ones, 2, 2)
    images = torch.tensor([[[[1.0], [2.0]], [[3.0], [4.0]]]], dtype=dtype)
    average = weighted_color_average(gaussians, cameras, images, backend=backend)
    assert average.weighted_sum[0, :, 0].tolist() == pytest.approx([3.75, 2.5], abs=1e-4)
    assert average.weight_sum[0].tolist() == pytest.approx([1.5, 1.0], abs=1e-4)
    assert average.max_weight[0].tolist() == pytest.approx([0.375, 0.25], abs=1e-5)


def test_sums_repeat_the_rendering(fast_backend):
    scene = random_scene(2)
    gaussians, cameras = in_float32(scene)
    rendered = rasterize(gaussians, cameras, backend=fast_backend, with_visibility=True)
    ones = torch.ones(3, cameras.height, cameras.width, 1)
    average = weighted_color_average(gaussians, cameras, ones, backend=fast_backend)
    # Summed over the Gaussians the weights are alpha, and weighted by colour they are the image.
    torch.testing.assert_close(average.weight_sum.sum(1), rendered.alpha.sum((1, 2, 3)))
    colors = (average.weight_sum[..., None] * gaussians.colors).sum(1)
    torch.testing.assert_close(colors, rendered.image.sum((1, 2)), rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(average.max_weight, rendered.visibility, atol=1e-6, rtol=0)
    torch.testing.assert_close(average.weighted_sum[..., 0], average.weight_sum)


def test_carries_no_gradient(fast_backend):
    scene = random_scene(3)
    gaussians, cameras = in_float32(scene)
    gaussians.means.requires_grad_()
    images = torch.ones(3, cameras.height, cameras.width, 3)
    average = weighted_color_average(gaussians, cameras, images, backend=fast_backend)
    assert not average.weighted_sum.requires_grad
