"""The only entrance to the rasterizer: checks its arguments and hands them to a backend."""

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.checks import holds_nonfinite
from rgbavatar_ns.kernels.constants import MAX_AVERAGE_CHANNELS
from rgbavatar_ns.kernels.registry import available_backends, choose
from rgbavatar_ns.kernels.types import GaussianSet, PinholeCameras, RenderedBatch, WeightedColors

__all__ = ["available_backends", "rasterize", "weighted_color_average"]

_WIDTHS = {"means": (3,), "quats_wxyz": (4,), "scales": (3,), "opacities": (), "colors": (3,)}
_MAX_SIDE_PX = 65536


def rasterize(
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    background: Float[Tensor, "3"] | Float[Tensor, "#B 3"] | None = None,
    *,
    backend: str = "auto",
    with_depth: bool = False,
    with_visibility: bool = False,
    screen_offset: Float[Tensor, "B N 2"] | None = None,
) -> RenderedBatch:
    """B images of B Gaussian sets: image = sum w_i c_i + (1 - alpha) background (None is black).

    Every attribute, the cameras and the background have a leading dimension of B or 1; what is
    1 is shared by the batch and its gradient is summed. Gradients flow from image and alpha to
    means, quats_wxyz, scales, opacities, colors and background, not to the cameras.

    `screen_offset` moves each image's projected means by so many pixels, x to the right and y
    down; depths and projected shapes stay. Its gradient is that of the projected mean, which
    density control asks for: pass zeros that require it. 3DGS compares its threshold with the
    gradient in normalised device coordinates, whose unit is (width / 2, height / 2) px, of ONE
    image's mean loss: of a mean over B images multiply it by B (width / 2, height / 2).

    "auto" takes the fastest backend for the tensors' device and type; float64 is drawn by the
    reference. Raises ValueError for shapes, types, devices or cameras that do not fit.
    Source: 3D Gaussian splatting (Kerbl et al. 2023); exact rule in `kernels/reference.py`.
    """
    batch = _check(gaussians, cameras)
    background = checked_background(gaussians.means, background, batch)
    if screen_offset is not None:
        _check_offset(gaussians.means, screen_offset, max(batch, len(background)))
    chosen = choose(backend, gaussians.means.device, gaussians.means.dtype)
    return chosen.rasterize(
        gaussians,
        cameras,
        background,
        with_depth=with_depth,
        with_visibility=with_visibility,
        screen_offset=screen_offset,
    )


def weighted_color_average(
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    images: Float[Tensor, "B H W C"],
    *,
    backend: str = "auto",
) -> WeightedColors:
    """Per Gaussian the sums of w I and w over its image's pixels, and the largest w.

    `images` are of the cameras' size, with at most 8 channels. No gradient. Raises ValueError
    as `rasterize`. Source: RGBAvatar sec. 3.2 (colour initialisation).
    """
    batch = _check(gaussians, cameras)
    _check_like(gaussians.means, images, "images")
    if images.ndim != 4 or images.shape[1:3] != (cameras.height, cameras.width):
        raise ValueError(
            f"images are {_shape(images)}, the cameras' are {cameras.height} high and "
            f"{cameras.width} wide. Pass [B, H, W, C] of the cameras' size."
        )
    if not 1 <= images.shape[3] <= MAX_AVERAGE_CHANNELS:
        raise ValueError(
            f"images have {images.shape[3]} channels. Pass 1 to {MAX_AVERAGE_CHANNELS}."
        )
    _join(batch, "images", images.shape[0])
    chosen = choose(backend, gaussians.means.device, gaussians.means.dtype)
    return chosen.weighted_color_average(gaussians, cameras, images)


def checked_background(
    like: Tensor, background: Tensor | None, batch: int
) -> Float[Tensor, "#B 3"]:
    """Return the background of a batch of B images; None is black. Raises as `rasterize`."""
    if background is None:
        return like.new_zeros(1, 3)
    background = background.reshape(-1, background.shape[-1]) if background.ndim else background
    _check_like(like, background, "background")
    if background.ndim != 2 or background.shape[1] != 3:
        raise ValueError(f"background is {_shape(background)}. Pass [3] or [B, 3].")
    if holds_nonfinite(background):
        raise ValueError("background holds NaN or infinity. Pass a colour.")
    _join(batch, "background", background.shape[0])
    return background


def _shape(tensor: Tensor) -> str:
    return str(list(tensor.shape))


def _check_like(like: Tensor, tensor: Tensor, name: str) -> None:
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise ValueError(
            f"{name}: {tensor.dtype} on {tensor.device}, but the means are {like.dtype} on "
            f"{like.device}. Convert with .to(means)."
        )


def _check_offset(means: Tensor, screen_offset: Tensor, batch: int) -> None:
    _check_like(means, screen_offset, "screen_offset")
    if tuple(screen_offset.shape) != (batch, means.shape[1], 2):
        raise ValueError(
            f"screen_offset is {_shape(screen_offset)}. Pass [{batch}, {means.shape[1]}, 2]: "
            "each image's own for every Gaussian."
        )


def _join(batch: int, name: str, leading: int) -> int:
    """The batch size when something with this leading dimension joins it."""
    if leading == 0:
        raise ValueError(f"{name}: leading dimension 0. Pass at least 1: there is no empty batch.")
    if leading != batch and 1 not in (leading, batch):
        raise ValueError(
            f"{name}: leading dimension {leading} in a batch of {batch}. Pass {batch} or 1."
        )
    return max(leading, batch)


def _check(gaussians: GaussianSet, cameras: PinholeCameras) -> int:
    """The common batch size."""
    means = gaussians.means
    if not means.is_floating_point():
        raise ValueError(f"means are {means.dtype}. Pass a floating-point type.")
    count = means.shape[1] if means.ndim == 3 else -1
    batch = 1
    for name, width in _WIDTHS.items():
        tensor = getattr(gaussians, name)
        _check_like(means, tensor, name)
        if tensor.ndim != 2 + len(width) or tensor.shape[1:] != (count, *width):
            expected = ", ".join(["B or 1", "N" if count < 0 else str(count), *map(str, width)])
            raise ValueError(f"{name} are {_shape(tensor)}. Pass [{expected}].")
        batch = _join(batch, name, tensor.shape[0])
    return _join(batch, "cameras", check_cameras(means, cameras))


def check_cameras(means: Tensor, cameras: PinholeCameras) -> int:
    """Return the number of cameras. Raises as `rasterize`."""
    count = cameras.world_to_camera.shape[0]
    for name, shape in (
        ("world_to_camera", (count, 4, 4)),
        ("focal_px", (count, 2)),
        ("principal_point_px", (count, 2)),
    ):
        tensor = getattr(cameras, name)
        _check_like(means, tensor, name)
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} is {_shape(tensor)}. Pass {list(shape)}.")
        if holds_nonfinite(tensor):
            raise ValueError(f"{name} holds NaN or infinity. Check where the camera comes from.")
    if cameras.focal_px.device.type == "cpu" and (cameras.focal_px <= 0).any():
        raise ValueError("focal_px must be positive. Cameras here look along +z, y down (OpenCV).")
    for name in ("width", "height"):
        if not 1 <= getattr(cameras, name) <= _MAX_SIDE_PX:
            raise ValueError(f"{name} is {getattr(cameras, name)}. Pass 1 to {_MAX_SIDE_PX}.")
    return count
