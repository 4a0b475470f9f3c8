import pytest
import torch

from rgbavatar_ns.bench.gsplat_torch import sorted_pairs
from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.scenes import ellipsoid_scene
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.kernels.constants import DILATION_PX2, MIN_ALPHA
from rgbavatar_ns.kernels.reference import project
from tests.kernels.scenes import random_scene


def alphas(gaussians: GaussianSet, cameras: PinholeCameras) -> torch.Tensor:
    """Alpha of every Gaussian at every pixel [B, N, H, W], by the specification's projection."""
    projected = project(gaussians, cameras)
    y, x = torch.meshgrid(torch.arange(cameras.height), torch.arange(cameras.width), indexing="ij")
    pixels = torch.stack([x, y], -1).to(projected.mean_px) + 0.5
    offset = pixels - projected.mean_px[:, :, None, None]
    conic = torch.linalg.inv(projected.covariance_px2)[:, :, None, None]
    distance = (offset[..., None, :] @ conic @ offset[..., None])[..., 0, 0]
    opacities = projected.opacities * projected.visible
    return opacities[:, :, None, None] * torch.exp(-0.5 * distance)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pairs_are_those_that_trying_every_pixel_finds(seed):
    scene = random_scene(seed, num_cameras=3, shared=("scales",))
    expected = int((alphas(scene.gaussians, scene.cameras) >= MIN_ALPHA).sum())
    assert expected > 1000
    assert count_pairs(scene.gaussians, scene.cameras) == expected


def test_a_round_gaussian_touches_the_pixels_of_its_disc():
    # At 1 m and a focal length of 1000 px, 1 mm is 1 px; q <= 2.2^2 holds for 13 pixel centres.
    variance = 1.0 + DILATION_PX2
    opacity = MIN_ALPHA * torch.exp(torch.tensor(0.5 * 2.2**2 / variance))
    gaussians = GaussianSet(
        torch.tensor([[[0.0, 0.0, 1.0]]]),
        torch.tensor([[[1.0, 0.0, 0.0, 0.0]]]),
        torch.full((1, 1, 3), 1e-3),
        opacity.reshape(1, 1),
        torch.ones(1, 1, 3),
    )
    focal, centre = torch.full((1, 2), 1000.0), torch.full((1, 2), 8.5)
    cameras = PinholeCameras(torch.eye(4)[None], focal, centre, 16, 16)
    assert count_pairs(gaussians, cameras) == 13


def test_nothing_in_view_has_no_pairs():
    gaussians, cameras = ellipsoid_scene(50, 16, 1)
    gaussians.opacities.zero_()
    assert count_pairs(gaussians, cameras) == 0


def test_the_sorted_list_holds_every_pair_once_by_pixel_and_depth():
    gaussians, cameras = ellipsoid_scene(300, 64, 1)
    gaussian, pixel = sorted_pairs(gaussians, cameras)
    assert len(pixel) == count_pairs(gaussians, cameras)
    keys = pixel * 300 + gaussian
    assert len(torch.unique(keys)) == len(keys)
    assert bool((pixel.diff() >= 0).all())
    depth = gaussians.means[0, gaussian, 2]
    same = pixel.diff() == 0
    assert bool((depth.diff()[same] >= 0).all())
