import pytest
import torch

from rgbavatar_ns.bench.pairs import count_pairs
from rgbavatar_ns.bench.projection import one_camera, one_image, project, row_spans, visible_index
from rgbavatar_ns.bench.scenes import ellipsoid_scene
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.kernels.constants import DILATION_PX2, MIN_ALPHA
from rgbavatar_ns.kernels.reference import project as reference_project
from tests.kernels.scenes import random_scene


def alphas(gaussians: GaussianSet, cameras: PinholeCameras) -> torch.Tensor:
    """Alpha of every Gaussian at every pixel [B, N, H, W], by the specification's projection."""
    projected = reference_project(gaussians, cameras)
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


def test_chunks_of_rows_cover_the_same_pixels():
    gaussians, cameras = ellipsoid_scene(300, 64, 1)
    projected = project(gaussians, cameras, visible_index(gaussians, cameras))
    whole = row_spans(projected, 64, 64)
    parts = row_spans(projected, 64, 64, max_rows=50)
    assert len(whole) == 1
    assert len(parts) > 3
    for name in ("index", "row", "first", "last"):
        joined = torch.cat([getattr(part, name) for part in parts])
        assert torch.equal(joined, getattr(whole[0], name))


def test_projection_agrees_with_the_specification():
    scene = random_scene(4, num_cameras=3, batch=3)
    expected = reference_project(scene.gaussians, scene.cameras)
    for position in range(3):
        single = one_image(scene.gaussians, position)
        camera = one_camera(scene.cameras, position)
        index = visible_index(single, camera)
        assert torch.equal(index, torch.nonzero(expected.visible[position])[:, 0])
        mine = project(single, camera, index)
        covariance = expected.covariance_px2[position, index]
        inverse = torch.linalg.inv(covariance)
        conic = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
        torch.testing.assert_close(mine.mean_px, expected.mean_px[position, index])
        torch.testing.assert_close(mine.conic, conic)
        torch.testing.assert_close(mine.variance_px2, covariance.diagonal(dim1=1, dim2=2))
        torch.testing.assert_close(mine.depth_m, expected.depth_m[position, index])
