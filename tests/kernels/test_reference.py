"""The specification against values worked by hand, finite differences and another library."""

import math

import pytest
import torch

from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, available_backends, rasterize
from rgbavatar_ns.kernels.reference import BlendingRules, project, rasterize_reference
from tests.kernels.scenes import changed, random_scene

DTYPES = {"reference": torch.float64, "cpu": torch.float32}


def _camera(size: int, dtype: torch.dtype) -> PinholeCameras:
    focal, half = (torch.full((1, 2), value, dtype=dtype) for value in (8.0, size / 2))
    return PinholeCameras(torch.eye(4, dtype=dtype)[None], focal, half, size, size)


def _gaussians(dtype, depth_m, opacity, color, sigma_m=0.25) -> GaussianSet:
    """Round Gaussians on the optical axis, one per depth."""
    count = len(depth_m)
    means = torch.tensor([[[0.0, 0.0, z] for z in depth_m]], dtype=dtype)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=dtype).expand(1, count, 4)
    scales = torch.full((1, count, 3), sigma_m, dtype=dtype)
    opacities = torch.tensor([opacity], dtype=dtype)
    return GaussianSet(means, quats, scales, opacities, torch.tensor([color], dtype=dtype))


@pytest.mark.parametrize("backend", available_backends())
def test_one_gaussian_by_hand(backend):
    # On the axis at z = 2 with f = 8: sigma is 0.25 * 8 / 2 = 1 px, so cov = 1 + .3 on both axes.
    dtype = DTYPES[backend]
    gaussians = _gaussians(dtype, [2.0], [0.6], [[0.2, 0.5, 1.0]])
    background = torch.tensor([1.0, 0.0, 0.25], dtype=dtype)
    rendered = rasterize(gaussians, _camera(6, dtype), background, backend=backend, with_depth=True)
    # The pixel (x, y) = (4, 2) has its centre at (4.5, 2.5): (1.5, -.5) from the mean (3, 3).
    alpha = 0.6 * math.exp(-0.5 * (1.5**2 + 0.5**2) / 1.3)
    expected = [alpha * c + (1 - alpha) * b for c, b in zip([0.2, 0.5, 1.0], [1.0, 0.0, 0.25])]
    assert rendered.image[0, 2, 4].tolist() == pytest.approx(expected, abs=3e-6)
    assert rendered.alpha[0, 2, 4].item() == pytest.approx(alpha, abs=3e-6)
    assert rendered.depth is not None
    assert rendered.depth[0, 2, 4].item() == pytest.approx(2.0, rel=1e-5)


@pytest.mark.parametrize("backend", available_backends())
def test_two_gaussians_blend_front_to_back(backend):
    dtype = DTYPES[backend]
    # The farther one comes first in memory. Huge ones, so that alpha is the opacity everywhere.
    gaussians = _gaussians(
        dtype, [4.0, 2.0], [0.5, 0.25], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], sigma_m=1e4
    )
    rendered = rasterize(
        gaussians, _camera(4, dtype), backend=backend, with_depth=True, with_visibility=True
    )
    assert rendered.image[0, 1, 1].tolist() == pytest.approx([0.75 * 0.5, 0.25, 0.0], abs=1e-5)
    assert rendered.alpha[0, 1, 1].item() == pytest.approx(1 - 0.75 * 0.5, abs=1e-5)
    assert rendered.depth is not None
    assert rendered.visibility is not None
    expected_depth = (0.25 * 2 + 0.375 * 4) / 0.625
    assert rendered.depth[0, 1, 1].item() == pytest.approx(expected_depth, abs=1e-4)
    assert rendered.visibility[0].tolist() == pytest.approx([0.375, 0.25], abs=1e-5)


@pytest.mark.parametrize("backend", available_backends())
@pytest.mark.parametrize(("depth_m", "drawn"), [(0.0101, True), (0.0099, False), (-2.0, False)])
def test_near_plane(backend, depth_m, drawn):
    dtype = DTYPES[backend]
    gaussians = _gaussians(dtype, [depth_m], [0.5], [[1.0, 1.0, 1.0]], sigma_m=1e-3)
    rendered = rasterize(gaussians, _camera(4, dtype), backend=backend)
    assert bool(rendered.alpha.max() > 0) is drawn


@pytest.mark.parametrize("backend", available_backends())
def test_alphas_are_capped_and_cut(backend):
    dtype = DTYPES[backend]
    full = _gaussians(dtype, [2.0], [1.0], [[1.0, 1.0, 1.0]], sigma_m=1e4)
    alpha = rasterize(full, _camera(4, dtype), backend=backend).alpha
    torch.testing.assert_close(alpha, torch.full_like(alpha, 0.999), atol=1e-6, rtol=0)
    faint = _gaussians(dtype, [2.0], [0.99 / 255], [[1.0, 1.0, 1.0]], sigma_m=1e4)
    assert rasterize(faint, _camera(4, dtype), backend=backend).alpha.max() == 0


@pytest.mark.parametrize("backend", available_backends())
def test_a_block_ends_when_all_of_its_pixels_are_opaque(backend):
    dtype = DTYPES[backend]
    # Alphas of .98: T is 1, .02, 4e-4, 8e-6; the fourth Gaussian finds T < 1e-4 and is dropped.
    four = ([2.0, 2.1, 2.2, 2.3], [0.98] * 4, [[0.0] * 3] * 3 + [[1e5] * 3])
    wall = _gaussians(dtype, *four, sigma_m=1e4)
    assert rasterize(wall, _camera(4, dtype), backend=backend).image.max() == 0
    # One pixel of the block is hardly covered by the wall: then all of the block goes on.
    hole = _gaussians(dtype, *four, sigma_m=0.6)
    image = rasterize(hole, _camera(4, dtype), backend=backend).image
    full = rasterize_reference(
        hole, _camera(4, dtype), hole.colors.new_zeros(1, 3), rules=BlendingRules(False, False)
    ).image
    assert image.min() > 0
    torch.testing.assert_close(image, full, rtol=1e-3, atol=1e-2)


def test_gradients_match_finite_differences_through_a_smooth_cutoff():
    scene = random_scene(3, batch=2, count=3, width=5, height=3, extremes=False)
    gaussians = scene.gaussians
    inputs = [
        gaussians.means * 0.5,
        gaussians.quats_wxyz,
        gaussians.scales * 2,
        0.3 + 0.5 * gaussians.opacities,
        gaussians.colors,
        scene.background[None],
    ]
    rules = BlendingRules(smooth_cutoff=True, block_stopping=False)

    def draw(*values):
        rendered = rasterize_reference(
            GaussianSet(*values[:5]), scene.cameras, values[5], rules=rules
        )
        return rendered.image, rendered.alpha

    leaves = tuple(value.clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(draw, leaves, atol=1e-6, rtol=1e-4)


def test_projection_agrees_with_gsplat():
    torch_impl = pytest.importorskip("gsplat.cuda._torch_impl")
    scene = random_scene(11, batch=1, count=300, extremes=False)
    scene = changed(scene, means=scene.gaussians.means * 2)  # some outside
    gaussians, cameras = scene.gaussians, scene.cameras
    projected = project(gaussians, cameras)
    covariances, _ = torch_impl._quat_scale_to_covar_preci(
        gaussians.quats_wxyz[0], gaussians.scales[0], compute_preci=False
    )
    intrinsics = torch.eye(3, dtype=torch.float64)[None].clone()
    intrinsics[:, [0, 1], [0, 1]] = cameras.focal_px
    intrinsics[:, :2, 2] = cameras.principal_point_px
    _, means_px, depths, conics, _ = torch_impl._fully_fused_projection(
        gaussians.means[0],
        covariances,
        cameras.world_to_camera,
        intrinsics,
        cameras.width,
        cameras.height,
    )
    visible = projected.visible[0]
    assert visible.sum() > 100
    conic = torch.linalg.inv(projected.covariance_px2[0])
    ours = torch.stack([conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1]], -1)
    torch.testing.assert_close(projected.mean_px[0, visible], means_px[0, visible])
    torch.testing.assert_close(projected.depth_m[0, visible], depths[0, visible])
    torch.testing.assert_close(ours[visible], conics[0, visible], rtol=1e-6, atol=1e-9)
