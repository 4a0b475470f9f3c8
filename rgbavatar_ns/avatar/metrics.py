"""Image metrics under one protocol: full frame, black background, soft alpha, means over images.

It is that of the paper's comparisons: predictions are rendered over black and clamped to [0, 1],
targets are laid over black by their matte. `psnr_head` takes only the person's pixels (alpha above
.5): black surroundings, which every avatar gets right, raise the full frame's PSNR. Pixels that
nobody filmed do not count: PSNR leaves them out, SSIM and LPIPS see the prediction in both images.

Sharpness says what these do not: a blurred picture, which errs nowhere by much, has a high PSNR.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, channels_last
from torch.nn.functional import conv2d, max_pool2d, pad

from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss
from rgbavatar_ns.drawing.compositing import film_over, is_unfilmed, rgba_to_float
from rgbavatar_ns.errors import UserError

_BLUR_SIGMA_PX = 1.5
_BLUR_RADIUS_PX = 5
_BEST_DB = 100.0
"""PSNR of equal pictures, so that one of them leaves a mean of many finite."""


def psnr(
    image: Float[Tensor, "B H W 3"],
    target: Float[Tensor, "B H W 3"],
    inside: Bool[Tensor, "B H W"] | None = None,
) -> Float[Tensor, "B"]:
    """Return each image's peak signal-to-noise ratio in dB, for a range of 1.

    Over the pixels `inside`, if given: NaN where there are none. At most 100, also where images are
    equal.
    """
    # By hand: torchmetrics takes seconds to import, in the middle of a stream.
    error = (image - target).square().mean(-1)
    if inside is None:
        mean = error.mean((1, 2))
    else:
        mean = (error * inside).sum((1, 2)) / inside.sum((1, 2))
    return (-10 * mean.log10()).clamp(max=_BEST_DB)


def l1_over_black(
    image: Float[Tensor, "B H W 3"], rgba: UInt8[Tensor, "B H W 4"]
) -> Float[Tensor, "B"]:
    """Return each image's mean absolute difference from a frame over black, both in [0, 1]."""
    shown = image.clamp(0, 1)
    truth = film_over(rgba.to(shown.device), shown.new_zeros(3), shown)
    return (shown - truth).abs().mean(dim=(1, 2, 3))


def ssim(image: Float[Tensor, "B H W 3"], target: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B"]:
    """Return each image's structural similarity: Gaussian window, sigma 1.5, range 1.

    A mean over all pixels, beyond the border the image's reflection: torchmetrics' number, in half
    the time that it takes.
    """
    from pytorch_msssim import ssim as similarity_within

    whole = [pad(one.movedim(-1, 1), (5,) * 4, mode="reflect") for one in (image, target)]
    # Pixels as they lie in an image, as in `detail_energy`: planes would take twice as long.
    whole = [one.contiguous(memory_format=channels_last) for one in whole]
    return similarity_within(*whole, data_range=1.0, size_average=False)


def detail_energy(
    image: Float[Tensor, "B H W 3"], inside: Bool[Tensor, "B H W"]
) -> Float[Tensor, "B"]:
    """Return each image's energy of fine structure, summed where a window lies wholly `inside`.

    The squared difference to the image blurred by a Gaussian of sigma 1.5 px (11 x 11 taps), as a
    mean over channels and a sum over pixels divided by H W. Ours: the difference lets all that is
    finer than 8 px a period through alike, lashes, strands, edges of teeth; a Laplacian, whose gain
    grows with the square of the frequency, would see little but the finest octave: noise of film
    and codec. A window that touches anything not `inside` does not count, so that neither the
    silhouette, the strongest edge of a matted picture, nor what lies beyond it does.
    """
    places = torch.arange(-_BLUR_RADIUS_PX, _BLUR_RADIUS_PX + 1, device=image.device)
    taps = (-0.5 * (places.to(image.dtype) / _BLUR_SIGMA_PX) ** 2).exp()
    taps = taps / taps.sum()
    # A group a channel, of pixels that lie as they do in an image: a twentieth of the time that a
    # batch of planes takes on a CPU.
    taps = taps.expand(3, 1, -1)
    planes, radius = image.movedim(-1, 1), _BLUR_RADIUS_PX
    blurred = conv2d(planes, taps[..., None], padding=(radius, 0), groups=3)
    blurred = conv2d(blurred, taps[:, :, None], padding=(0, radius), groups=3)
    energy = (planes - blurred).square().mean(1)
    # The picture's border counts as outside too.
    outside = pad((~inside[:, None]).to(image.dtype), (radius,) * 4, value=1.0)
    along, window = (1, 2 * radius + 1), (2 * radius + 1, 1)
    whole = max_pool2d(max_pool2d(outside, along, stride=1), window, stride=1)[:, 0] == 0
    return (energy * whole).mean((1, 2))


def mean_scores(frames: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Each score's mean over the frames that have it; NaN where none has.

    A frame without the person has no `psnr_head`, one that nobody filmed has no score at all.
    """
    names = dict.fromkeys(name for scores in frames for name in scores)
    known = {n: [s[n] for s in frames if n in s and not math.isnan(s[n])] for n in names}
    return {name: statistics.fmean(them) if them else math.nan for name, them in known.items()}


def with_sharpness(means: Mapping[str, Any], suffix: str = "") -> dict[str, Any]:
    """Scores of frames in which `sharpness` stands for the two energies it is the ratio of.

    The fine structure of all pictures against that of all the film's frames: 1 is as sharp as the
    film, less is blurred, more is noise or structure that the film does not have. The ratio is of
    the means, so that a frame blurred by motion does not outweigh the others. The film's own noise
    counts as its detail: an avatar without noise stays below 1. Left out where the film shows no
    fine structure. suffix: of the scores' names.
    """
    rest = dict(means)
    detail = rest.pop(f"detail{suffix}")
    film = rest.pop(f"detail_film{suffix}")
    return {**rest, f"sharpness{suffix}": detail / film} if film > 0 else rest


class LPIPSMetric:
    """LPIPS that reports itself unavailable instead of failing, and tries only once."""

    def __init__(self, net: Literal["vgg", "alex", "squeeze"] = "vgg") -> None:
        self.net: Literal["vgg", "alex", "squeeze"] = net
        self.unavailable: str | None = None
        self._loss = LPIPSLoss(net)

    @torch.no_grad()
    def __call__(
        self, image: Float[Tensor, "B H W 3"], target: Float[Tensor, "B H W 3"]
    ) -> Float[Tensor, ""] | None:
        """Return the mean over the batch, or None once `unavailable` says why."""
        if self.unavailable is None:
            try:
                return self._loss(image, target)
            except UserError as error:
                self.unavailable = str(error)
        return None


@torch.no_grad()
def evaluate_images(
    image: Float[Tensor, "B H W 3"],
    target_rgba: Float[Tensor, "B H W 4"] | UInt8[Tensor, "B H W 4"],
    lpips: LPIPSMetric | None = None,
) -> dict[str, float | str | None]:
    """Compare images rendered over black with their targets, under the module's protocol.

    Returns means over the images: `psnr` and `psnr_head` (dB), `ssim`, `detail` and `detail_film`
    (`detail_energy` of the person, which `with_sharpness` compares) and, where `lpips` was given,
    `lpips_<network>`: None where it is unavailable, with the reason as `lpips_unavailable`.
    """
    image = image.clamp(0, 1)
    target = film_over(target_rgba, image.new_zeros(3), image)
    person = rgba_to_float(target_rgba, image.dtype)[..., 3] > 0.5
    filmed = ~is_unfilmed(target_rgba)
    values: dict[str, float | str | None] = {
        "psnr": float(psnr(image, target, filmed).mean()),
        "psnr_head": float(psnr(image, target, person).mean()),
        "ssim": float(ssim(image, target).mean()),
        "detail": float(detail_energy(image, person & filmed).mean()),
        "detail_film": float(detail_energy(target, person & filmed).mean()),
    }
    if lpips is not None:
        perceptual = lpips(image, target)
        values[f"lpips_{lpips.net}"] = None if perceptual is None else float(perceptual)
        if lpips.unavailable is not None:
            values["lpips_unavailable"] = lpips.unavailable
    return values
