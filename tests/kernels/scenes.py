"""Random scenes, and what the tests ask of a rendering."""

from dataclasses import dataclass, fields, is_dataclass, replace

import torch
from torch import Tensor

from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize
from rgbavatar_ns.kernels.constants import MAX_ALPHA, MIN_ALPHA
from rgbavatar_ns.kernels.reference import project

ATTRIBUTES = ("means", "quats_wxyz", "scales", "opacities", "colors")


@dataclass(frozen=True)
class Scene:
    """float64 inputs, and the gradients that arrive at image and alpha; offsets are [B, N, 2]."""

    gaussians: GaussianSet
    cameras: PinholeCameras
    background: Tensor
    image_grad: Tensor
    alpha_grad: Tensor
    screen_offset: Tensor | None = None


def to(value, like):
    """The dataclass and those in it with their tensors converted and detached."""
    if isinstance(value, Tensor):
        return value.detach().to(like).clone()
    if not is_dataclass(value):
        return value
    return type(value)(**{f.name: to(getattr(value, f.name), like) for f in fields(value)})


def changed(scene: Scene, **attributes: Tensor) -> Scene:
    """The scene with these attributes of its Gaussians."""
    return replace(scene, gaussians=replace(scene.gaussians, **attributes))


def moved(scene: Scene, spread_px: float = 6.0) -> Scene:
    """The scene with offsets of its own for every Gaussian in every image."""
    count = scene.gaussians.means.shape[1]
    generator = torch.Generator().manual_seed(17)
    offset = torch.randn(len(scene.image_grad), count, 2, generator=generator).double()
    return replace(scene, screen_offset=spread_px * offset)


def in_float32(scene: Scene) -> tuple[GaussianSet, PinholeCameras]:
    """What is drawn, as the fast backends take it."""
    return to(scene.gaussians, torch.float32), to(scene.cameras, torch.float32)


def random_cameras(generator, count: int, width: int, height: int, distance_m: float = 2.3):
    """Cameras around the origin, principal points off the centre."""
    matrix, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    world_to_camera = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    world_to_camera[:, :3, :3] = matrix * torch.linalg.det(matrix)[:, None, None]
    world_to_camera[:, :2, 3] = 0.1
    world_to_camera[:, 2, 3] = distance_m
    side = torch.tensor([width, height], dtype=torch.float64)
    focal_px = max(width, height) * torch.tensor([[1.1, 0.95]], dtype=torch.float64)
    return PinholeCameras(
        world_to_camera,
        focal_px.repeat(count, 1),
        (side / 2 + torch.tensor([0.7, -1.3])).repeat(count, 1),
        width,
        height,
    )


def random_scene(
    seed: int,
    *,
    batch: int = 3,
    count: int = 200,
    width: int = 37,
    height: int = 29,
    num_cameras: int = 1,
    shared: tuple[str, ...] = (),
    extremes: bool = True,
) -> Scene:
    """Gaussians around the origin and, with `extremes`, some that are hard to draw.

    `shared` names the attributes with a leading dimension of 1.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    def uniform(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, dtype=torch.float64)

    def leading(name: str) -> int:
        return 1 if name in shared else batch

    cameras = random_cameras(generator, num_cameras, width, height)
    means = 1.6 * (uniform(leading("means"), count, 3) - 0.5)
    scales = torch.exp(0.7 * normal(leading("scales"), count, 3) - 3.2)
    opacities = uniform(leading("opacities"), count)
    if extremes and count >= 60:
        means[:, :10] *= 8  # behind the camera or outside the image
        backwards = cameras.world_to_camera[0, 2, :3]
        means[:, 10:20] -= 3.5 * backwards  # behind the first camera
        scales[:, 20:25] = 1e-6
        scales[:, 25] = 4.0
        opacities[:, 30:35] = 0.0
        opacities[:, 35:40] = 1.0  # alphas that are capped
        scales[:, 40:45, 0] = 0.0
    gaussians = GaussianSet(
        means,
        normal(leading("quats_wxyz"), count, 4),
        scales,
        opacities,
        uniform(leading("colors"), count, 3),
    )
    size = (max(batch, num_cameras), height, width)
    return Scene(gaussians, cameras, uniform(3), normal(*size, 3), normal(*size, 1))


def settled_pixels(scene: Scene, margin: float = 1e-4) -> Tensor:
    """Pixels [B, H, W, 1] where no alpha is so near the cut or cap that rounding decides."""
    projected = project(scene.gaussians, scene.cameras, scene.screen_offset)
    y, x = torch.meshgrid(
        torch.arange(scene.cameras.height), torch.arange(scene.cameras.width), indexing="ij"
    )
    pixels = torch.stack([x, y], -1).to(projected.mean_px) + 0.5
    offset = pixels[None, :, :, None] - projected.mean_px[:, None, None]
    conic = torch.linalg.inv(projected.covariance_px2)[:, None, None]
    distance = (offset[..., None, :] @ conic @ offset[..., None])[..., 0, 0]
    alpha = projected.opacities[:, None, None] * torch.exp(-0.5 * distance)
    near = (alpha / MIN_ALPHA - 1).abs() < margin
    near = near | ((alpha / MAX_ALPHA - 1).abs() < 1e-5)
    return ~near.any(-1, keepdim=True)


def render_and_differentiate(
    scene: Scene, dtype: torch.dtype, backend: str, mask=None, device: str = "cpu"
):
    """The rendering and the gradients of all attributes, the background and offsets, in float64."""
    scene, mask = to(scene, device), None if mask is None else mask.to(device)
    gaussians, cameras = to(scene.gaussians, dtype), to(scene.cameras, dtype)
    background = scene.background.to(dtype).clone().requires_grad_()
    leaves = {name: getattr(gaussians, name).requires_grad_() for name in ATTRIBUTES}
    leaves["background"] = background
    if scene.screen_offset is not None:
        leaves["screen_offset"] = to(scene.screen_offset, dtype).requires_grad_()
    rendered = rasterize(
        gaussians,
        cameras,
        background,
        backend=backend,
        with_depth=True,
        with_visibility=True,
        screen_offset=leaves.get("screen_offset"),
    )
    mask = torch.ones_like(scene.alpha_grad) if mask is None else mask
    loss = (rendered.image * (mask * scene.image_grad).to(dtype)).sum()
    loss = loss + (rendered.alpha * (mask * scene.alpha_grad).to(dtype)).sum()
    loss.backward()
    gradients = {name: torch.as_tensor(leaf.grad).double().cpu() for name, leaf in leaves.items()}
    return to(to(rendered, torch.float64), "cpu"), gradients


def relative_l2(value: Tensor, expected: Tensor) -> float:
    """|value - expected| / |expected|."""
    return float((value - expected).norm() / expected.norm().clamp(min=1e-12))
