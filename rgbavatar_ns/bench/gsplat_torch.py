"""gsplat's functions in torch beside ours, as far as they run without CUDA.

gsplat's projection and `accumulate` are used as they are. Two pieces need CUDA and are given: the
list of (Gaussian, pixel) pairs, made before the clock starts, and nerfacc's scan along rays
inside `accumulate`, as a cumulative sum of logarithms.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.bench.pairs import pixel_pairs
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras
from rgbavatar_ns.kernels.reference import project


def gsplat_torch(
    gaussians: GaussianSet, cameras: PinholeCameras
) -> Callable[[GaussianSet], Float[Tensor, "1 H W 3"]]:
    """A function that draws one image; raises ImportError where gsplat or nerfacc is missing."""
    import nerfacc
    from gsplat.cuda import _torch_impl as gsplat

    width, height = cameras.width, cameras.height
    gaussian_ids, pixel_ids = sorted_pairs(gaussians, cameras)
    camera_ids = torch.zeros_like(gaussian_ids)
    intrinsics = torch.eye(3)[None].to(cameras.focal_px).clone()
    intrinsics[:, [0, 1], [0, 1]] = cameras.focal_px
    intrinsics[:, :2, 2] = cameras.principal_point_px

    def draw(gaussians: GaussianSet) -> Float[Tensor, "1 H W 3"]:
        covariance, _ = gsplat._quat_scale_to_covar_preci(
            gaussians.quats_wxyz[0], gaussians.scales[0], True, False
        )
        assert covariance is not None
        _, mean_px, _, conic, _ = gsplat._fully_fused_projection(
            gaussians.means[0], covariance, cameras.world_to_camera, intrinsics, width, height
        )
        with _torch_scan(nerfacc):
            image, _ = gsplat.accumulate(
                mean_px,
                conic,
                gaussians.opacities,
                gaussians.colors,
                gaussian_ids,
                pixel_ids,
                camera_ids,
                width,
                height,
            )
        return image

    return draw


@torch.no_grad()
def sorted_pairs(
    gaussians: GaussianSet, cameras: PinholeCameras
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Gaussian and pixel of an image's pairs by pixel, and from front to back within one."""
    gaussian, pixel = pixel_pairs(gaussians, cameras)
    rank = project(gaussians, cameras).depth_m[0].argsort(stable=True).argsort()
    order = torch.argsort(pixel * len(rank) + rank[gaussian])
    return gaussian[order], pixel[order]


@contextmanager
def _torch_scan(nerfacc: object) -> Iterator[None]:
    """Let nerfacc's weights along rays be computed by torch within."""
    original = nerfacc.render_weight_from_alpha  # pyright: ignore[reportAttributeAccessIssue]
    nerfacc.render_weight_from_alpha = _weights  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        nerfacc.render_weight_from_alpha = original  # pyright: ignore[reportAttributeAccessIssue]


def _weights(
    alphas: Float[Tensor, "m"], *, ray_indices: Int[Tensor, "m"], n_rays: int
) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """Weights and transmittances of samples ordered by ray: w_i = alpha_i prod_j<i (1 - alpha_j).

    The logarithms are summed over all rays at once, in float64 so that no ray loses digits.
    """
    logarithm = torch.log1p(-alphas.double())
    before = torch.cumsum(logarithm, 0) - logarithm
    count = torch.bincount(ray_indices, minlength=n_rays)
    count = count[count > 0]
    first = torch.cumsum(count, 0) - count
    transmittance = torch.exp(before - torch.repeat_interleave(before[first], count)).to(alphas)
    return alphas * transmittance, transmittance
