import pytest
import torch

from rgbavatar_ns.bench.drawing import leaf_gaussians
from rgbavatar_ns.bench.gsplat_torch import _weights, pixel_pairs
from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.peers import PEERS, time_peers
from rgbavatar_ns.bench.scenes import ellipsoid_scene
from rgbavatar_ns.bench.timing import Stopwatch
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize
from tests.kernels.scenes import relative_l2


def ours(gaussians, cameras):
    return lambda leaves: rasterize(leaves, cameras).image


def image_and_gradients(adapter, gaussians: GaussianSet, cameras: PinholeCameras):
    leaves = leaf_gaussians(gaussians)
    image = adapter(gaussians, cameras)(leaves)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(3))
    image.backward(weights)
    return image.detach(), {name: leaf.grad for name, leaf in vars(leaves).items()}


@pytest.mark.parametrize("name", list(PEERS))
@pytest.mark.parametrize("size", [64, 37])
def test_a_peer_draws_our_picture_with_our_gradients(name, size):
    pytest.importorskip("gsplat")
    gaussians, cameras = ellipsoid_scene(300, size, 1, seed=5)
    image, gradients = image_and_gradients(PEERS[name], gaussians, cameras)
    expected, expected_gradients = image_and_gradients(ours, gaussians, cameras)
    assert float(expected.max()) > 0.1
    # A pair at the very cut of 1/255 may count for one and not for the other.
    assert float((image - expected).abs().max()) < 5e-3
    assert float((image - expected).abs().mean()) < 1e-5
    for attribute, gradient in gradients.items():
        assert relative_l2(gradient, expected_gradients[attribute]) < 5e-3, attribute


def test_the_pair_list_holds_every_pair_once_by_pixel_and_depth():
    gaussians, cameras = ellipsoid_scene(300, 64, 1)
    gaussian, pixel = pixel_pairs(gaussians, cameras)
    assert len(pixel) == count_pairs(gaussians, cameras)
    keys = pixel * 300 + gaussian
    assert len(torch.unique(keys)) == len(keys)
    assert bool((pixel.diff() >= 0).all())
    depth = gaussians.means[0, gaussian, 2]
    same = pixel.diff() == 0
    assert bool((depth.diff()[same] >= 0).all())


def test_weights_along_rays_are_the_running_product():
    alphas = torch.tensor([0.4, 0.8, 0.1, 0.8, 0.1, 0.0, 0.9])
    rays = torch.tensor([0, 0, 0, 2, 2, 3, 3])
    weights, transmittance = _weights(alphas, ray_indices=rays, n_rays=5)
    expected = torch.tensor([1.0, 0.6, 0.12, 1.0, 0.2, 1.0, 1.0])
    torch.testing.assert_close(transmittance, expected)
    torch.testing.assert_close(weights, alphas * expected)


def test_a_peer_of_ones_own_is_measured_and_a_missing_one_says_why():
    def reference(gaussians, cameras):
        return lambda leaves: rasterize(leaves, cameras, backend="reference").image

    def missing(gaussians, cameras):
        raise ImportError("No module named 'my_rasterizer'")

    gaussians, cameras = ellipsoid_scene(100, 32, 2)
    peers = {"reference": reference, "missing": missing}
    found = time_peers(ours, gaussians, cameras, 0.5, Stopwatch(1), peers)
    assert "No module named 'my_rasterizer'" in found["missing"]["unavailable"]
    figures = found["reference"]
    assert figures["forward_ms_per_image"] > 0
    assert figures["backward_ms_per_image"] > 0
    assert figures["ratio"] == pytest.approx(figures["whole_ms_per_image"] / 0.5)
    assert figures["mean_difference"] < 1e-5
    assert (figures["images"], figures["gaussians"], figures["width_px"]) == (1, 100, 32)
