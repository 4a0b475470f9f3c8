import pytest
import torch

from rgbavatar_ns.bench import rasterizer
from rgbavatar_ns.bench.gsplat_torch import _weights, gsplat_torch
from rgbavatar_ns.bench.scenes import ellipsoid_scene, leaf_gaussians
from rgbavatar_ns.bench.timing import Stopwatch
from rgbavatar_ns.kernels import rasterize
from tests.kernels.scenes import relative_l2


@pytest.mark.parametrize("size", [64, 37])
def test_it_draws_our_picture_with_our_gradients(size):
    pytest.importorskip("gsplat")
    gaussians, cameras = ellipsoid_scene(300, size, 1, seed=5)
    found = []
    for draw in (gsplat_torch(gaussians, cameras), lambda g: rasterize(g, cameras).image):
        leaves = leaf_gaussians(gaussians)
        image = draw(leaves)
        image.backward(torch.randn(image.shape, generator=torch.Generator().manual_seed(3)))
        found.append((image.detach(), {name: leaf.grad for name, leaf in vars(leaves).items()}))
    (image, gradients), (expected, expected_gradients) = found
    assert float(expected.max()) > 0.1
    # A pair at the very cut of 1/255 may count for one and not for the other.
    assert float((image - expected).abs().max()) < 5e-3
    assert float((image - expected).abs().mean()) < 1e-5
    for attribute, gradient in gradients.items():
        assert relative_l2(gradient, expected_gradients[attribute]) < 5e-3, attribute


def test_weights_along_rays_are_the_running_product():
    alphas = torch.tensor([0.4, 0.8, 0.1, 0.8, 0.1, 0.0, 0.9])
    rays = torch.tensor([0, 0, 0, 2, 2, 3, 3])
    weights, transmittance = _weights(alphas, ray_indices=rays, n_rays=5)
    expected = torch.tensor([1.0, 0.6, 0.12, 1.0, 0.2, 1.0, 1.0])
    torch.testing.assert_close(transmittance, expected)
    torch.testing.assert_close(weights, alphas * expected)


def test_it_is_measured_on_one_image_beside_ours():
    pytest.importorskip("gsplat")
    figures = rasterizer.time_gsplat(*ellipsoid_scene(100, 32, 2), Stopwatch(1), 0.5)
    assert figures["forward_ms_per_image"] > 0
    assert figures["backward_ms_per_image"] > 0
    assert figures["ratio"] == pytest.approx(figures["whole_ms_per_image"] / 0.5)
    assert figures["mean_difference"] < 1e-5


def test_where_it_is_missing_the_reason_is_told(monkeypatch):
    def missing(gaussians, cameras):
        raise ImportError("No module named 'gsplat'\nand more")

    monkeypatch.setattr(rasterizer, "gsplat_torch", missing)
    figures = rasterizer.time_gsplat(*ellipsoid_scene(100, 32, 2), Stopwatch(1), 0.5)
    assert figures == {"unavailable": "ImportError: No module named 'gsplat'"}
