"""Terms that other methods add to a loss: of pictures, and of Gaussians.

L1 and LPIPS are in `avatar.model.image_loss`. Pictures are compared with `film_over`'s, which is
the drawn picture itself where nobody filmed: terms pixel by pixel add nothing there. For DSSIM and
LPIPS, which look around a pixel, the drawn picture is to be held there too (`held_where`), or
gradients reach what nobody filmed.
"""

import functools
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from rgbavatar_ns.kernels import mean_similarity

SSIM_WINDOW_PX = 11
"""Side of the windows that SSIM compares; a picture holds one at least."""
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2


def mse_loss(
    image: Float[Tensor, "B H W 3"], target: Float[Tensor, "B H W 3"]
) -> Float[Tensor, ""]:
    """The mean squared difference."""
    return F.mse_loss(image, target)


def huber_loss(
    image: Float[Tensor, "B H W 3"],
    target: Float[Tensor, "B H W 3"],
    delta: float = 0.1,
    weight: Float[Tensor, "B H W"] | Bool[Tensor, "B H W"] | None = None,
) -> Float[Tensor, ""]:
    """The mean of d^2 / 2, beyond `delta` of delta (|d| - delta / 2), each pixel times its weight.

    The mean is over all pixels, whatever they weigh: a mask's pixels count as in the whole picture.
    Source: FlashAvatar (`utils/loss_utils.py`; in the mouth's mask 40 times).
    """
    if weight is None:
        return F.huber_loss(image, target, delta=delta)
    error = F.huber_loss(image, target, delta=delta, reduction="none")
    return (error * weight[..., None]).mean()


def held_where(
    image: Float[Tensor, "B H W 3"], unfilmed: Bool[Tensor, "B H W"]
) -> Float[Tensor, "B H W 3"]:
    """The same pictures, but no gradient reaches them where nobody filmed."""
    held = image.view_as(image)
    if held.requires_grad:
        held.register_hook(lambda gradient: gradient.masked_fill(unfilmed[..., None], 0.0))
    return held


def dssim_loss(
    image: Float[Tensor, "B H W 3"], target: Float[Tensor, "B H W 3"]
) -> Float[Tensor, ""]:
    """1 - SSIM: Gaussian windows of 11 x 11 pixels, sigma 1.5, range 1, mean over windows.

    Only windows that lie within the picture count; `avatar.metrics.ssim` continues pictures by
    reflection, 3D Gaussian splatting's loss by zeros. Raises ValueError for pictures below 11 x 11.
    """
    if min(image.shape[1:3]) < SSIM_WINDOW_PX:
        raise ValueError(
            f"Pictures are {tuple(image.shape[1:3])}. Pass {SSIM_WINDOW_PX} pixels or more."
        )
    return 1 - _MeanSimilarity.apply(image, target)


class _MeanSimilarity(torch.autograd.Function):
    """Mean SSIM with its gradient written out, in a backend's loops where there are any."""

    @staticmethod
    def forward(
        ctx: Any, image: Float[Tensor, "B H W 3"], target: Float[Tensor, "B H W 3"]
    ) -> Float[Tensor, ""]:
        needed, needed_there = ctx.needs_input_grad
        means, of_image = _similarities(image, target, needed)
        of_target = _similarities(target, image, True)[1] if needed_there else None
        count = len(image)
        ctx.gradients = [None if g is None else g / count for g in (of_image, of_target)]
        return means.mean()

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, Tensor | None]:
        first, second = (None if g is None else grad_outputs[0] * g for g in ctx.gradients)
        return first, second


def _similarities(
    x: Float[Tensor, "B H W 3"], y: Float[Tensor, "B H W 3"], with_gradient: bool
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B H W 3"] | None]:
    """Each pair's mean SSIM and, if asked, its gradient by x."""
    window = _window(x.dtype, x.device)
    found = mean_similarity(x, y, window, (_C1, _C2), with_gradient=with_gradient)
    if found is not None:
        return found
    # One image at a time, to stay within the caches.
    pairs = [_similarity(*pair, with_gradient) for pair in zip(x, y)]
    gradients = [gradient for _, gradient in pairs if gradient is not None]
    return torch.stack([mean for mean, _ in pairs]), torch.stack(gradients) if gradients else None


def _similarity(
    x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"], with_gradient: bool
) -> tuple[Float[Tensor, ""], Float[Tensor, "H W 3"] | None]:
    """Mean SSIM of two images (Wang et al. 2004, eq. 13) and, if asked, its gradient by x.

    SSIM is a1 a2 / (b1 b2) of windowed means of x, y, x^2 + y^2 and x y.
    """
    mean_x, mean_y, squares, product = _blurred(torch.stack([x, y, x * x + y * y, x * y]))
    means, mean_squares = mean_x * mean_y, mean_x.square() + mean_y.square()
    a1, a2 = 2 * means + _C1, 2 * (product - means) + _C2
    b1, b2 = mean_squares + _C1, squares - mean_squares + _C2
    inverse = 1 / (b1 * b2)
    similarity = a1 * a2 * inverse
    if not with_gradient:
        return similarity.mean(), None
    of_squares, of_product = -similarity / b2, 2 * a1 * inverse
    of_means = 2 * (a2 - a1) * inverse
    of_mean_squares = 2 * (similarity / b1 + of_squares).neg_()
    own = of_means * mean_y + of_mean_squares * mean_x
    stacked = torch.stack([own, of_squares, of_product]) / similarity.numel()
    from_mean, from_squares, from_product = _blurred(F.pad(stacked, _AROUND))
    return similarity.mean(), from_mean + 2 * x * from_squares + y * from_product


_AROUND = (0, 0, *((SSIM_WINDOW_PX - 1,) * 4))
"""Zeros around rows and columns, with which the window gives back what it took."""


def _blurred(maps: Float[Tensor, "M H W 3"]) -> Float[Tensor, "M h w 3"]:
    """Each channel under the window, where it lies within the map."""
    window = _window(maps.dtype, maps.device)
    down, across = window.view(1, 1, -1, 1), window.view(1, 1, 1, -1)
    # As seen by the convolution the channels lie innermost: ten times as fast as planes.
    channels = F.conv2d(maps.movedim(-1, 1), down.expand(3, 1, -1, 1), groups=3)
    return F.conv2d(channels, across.expand(3, 1, 1, -1), groups=3).movedim(1, -1)


@functools.cache
def _window(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "K"]:
    with torch.inference_mode(False):
        place = torch.arange(SSIM_WINDOW_PX, dtype=torch.float64) - SSIM_WINDOW_PX // 2
        weights = torch.exp(-place.square() / (2 * _SIGMA**2))
        return (weights / weights.sum()).to(device, dtype)


def coverage_loss(
    alpha: Float[Tensor, "B H W 1"],
    matte: Float[Tensor, "B H W"],
    counted: Bool[Tensor, "B H W"] | None = None,
) -> Float[Tensor, ""]:
    """The mean squared difference of drawn opacity and matte; pixels not counted add nothing.

    Source: GaussianBlendshapes (`train.py`: `alpha_loss`, 10 times).
    """
    error = (alpha[..., 0] - matte).square()
    return (error if counted is None else error * counted).mean()


def position_hinge(
    position: Float[Tensor, "N 3"], most: float = 1.0, seen: Bool[Tensor, "N"] | None = None
) -> Float[Tensor, ""]:
    """How far local positions are farther than `most` from their frame's origin, on average.

    Over those `seen`, if given; 0 where none is. Source: GaussianAvatars (eq. 4 and `train.py`: in
    units of the triangle's size, .01 times).
    """
    return _mean_over(F.relu(torch.linalg.vector_norm(position, dim=-1) - most), seen)


def scale_hinge(
    scales: Float[Tensor, "N 3"], most: float = 0.6, seen: Bool[Tensor, "N"] | None = None
) -> Float[Tensor, ""]:
    """The length of what scales exceed `most` by, on average over those `seen`.

    Source: GaussianAvatars (eq. 5 and `train.py`: in units of the triangle's size).
    """
    return _mean_over(torch.linalg.vector_norm(F.relu(scales - most), dim=-1), seen)


def spike_term(
    scales: Float[Tensor, "#B N 3"], largest: float, most_ratio: float = 10.0
) -> Float[Tensor, ""]:
    """The mean of Gaussians' largest scales, over those that are spikes; 0 where none is.

    A spike's scale is above `largest` and more than `most_ratio` times its smallest one. Source:
    SplattingAvatar (`model/loss_base.py`: .008 for a head four times as large, .002 m here).
    """
    longest, shortest = scales.amax(-1), scales.amin(-1)
    return _mean_over(longest, (longest > largest) & (longest > most_ratio * shortest))


def cylinder_term(
    position: Float[Tensor, "N 3"],
    centre: Float[Tensor, "3"],
    radius: float,
    half_height: float,
) -> Float[Tensor, ""]:
    """The mean squared distance to an upright cylinder (its axis is y), 0 within; square units.

    Source: GaussianBlendshapes (`mouth_gs_model.py`: teeth stay in the mouth, 100 times).
    """
    x, y, z = (position - centre).unbind(-1)
    beside = F.relu(torch.linalg.vector_norm(torch.stack([x, z], -1), dim=-1) - radius)
    beyond = F.relu(y.abs() - half_height)
    return (beside.square() + beyond.square()).mean()


def upright_cylinder(points: Float[Tensor, "M 3"]) -> tuple[Float[Tensor, "3"], float, float]:
    """Centre, radius and half the height of a cylinder for `cylinder_term` that holds all points.

    About the middle of their box; of no points nothing. Ours, in place of the release's numbers,
    which fit its own teeth (radius .0273 m, half height .0216 m).
    """
    if not len(points):
        return points.new_zeros(3), 0.0, 0.0
    low, high = points.amin(0), points.amax(0)
    centre = 0.5 * (low + high)
    radius = torch.linalg.vector_norm((points - centre)[:, [0, 2]], dim=1).max()
    return centre, float(radius), float(0.5 * (high - low)[1])


def _mean_over(values: Float[Tensor, "*n"], chosen: Bool[Tensor, "*n"] | None) -> Float[Tensor, ""]:
    """The mean of the chosen, 0 where there are none."""
    if chosen is None:
        return values.mean()
    return (values * chosen).sum() / chosen.sum().clamp(min=1)
