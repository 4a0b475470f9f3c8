"""Image metrics under one protocol: full frame, black background, soft alpha, means over images.

It is that of the paper's comparisons: predictions are rendered over black and clamped to [0, 1],
targets are laid over black by their matte. `psnr_head` takes only the person's pixels (alpha above
.5): black surroundings, which every avatar gets right, raise the full frame's PSNR. Pixels that
nobody filmed do not count: PSNR leaves them out, SSIM and LPIPS see the prediction in both images.
"""

from typing import Literal

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss
from rgbavatar_ns.drawing.compositing import film_over, is_unfilmed, rgba_to_float
from rgbavatar_ns.errors import UserError


def psnr(
    image: Float[Tensor, "B H W 3"],
    target: Float[Tensor, "B H W 3"],
    inside: Bool[Tensor, "B H W"] | None = None,
) -> Float[Tensor, "B"]:
    """Return each image's peak signal-to-noise ratio in dB, for a range of 1.

    Over the pixels `inside`, if given: NaN where there are none. Infinite where images are equal.
    """
    # By hand: torchmetrics takes seconds to import, in the middle of a stream.
    error = (image - target).square().mean(-1)
    if inside is None:
        return -10 * error.mean((1, 2)).log10()
    return -10 * ((error * inside).sum((1, 2)) / inside.sum((1, 2))).log10()


def l1_over_black(
    image: Float[Tensor, "B H W 3"], rgba: UInt8[Tensor, "B H W 4"]
) -> Float[Tensor, "B"]:
    """Return each image's mean absolute difference from a frame over black, both in [0, 1]."""
    shown = image.clamp(0, 1)
    truth = film_over(rgba.to(shown.device), shown.new_zeros(3), shown)
    return (shown - truth).abs().mean(dim=(1, 2, 3))


def ssim(image: Float[Tensor, "B H W 3"], target: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B"]:
    """Return each image's structural similarity: Gaussian window, sigma 1.5, range 1."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    similarity = structural_similarity_index_measure(
        image.movedim(-1, 1), target.movedim(-1, 1), data_range=1.0, reduction="none"
    )
    if not isinstance(similarity, Tensor):
        similarity = similarity[0]
    return similarity.reshape(len(image))


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

    Returns means over the images: `psnr` and `psnr_head` (dB), `ssim` and, where `lpips` was given,
    `lpips_<network>`: None where it is unavailable, with the reason as `lpips_unavailable`.
    """
    image = image.clamp(0, 1)
    target = film_over(target_rgba, image.new_zeros(3), image)
    person = rgba_to_float(target_rgba, image.dtype)[..., 3] > 0.5
    values: dict[str, float | str | None] = {
        "psnr": float(psnr(image, target, ~is_unfilmed(target_rgba)).mean()),
        "psnr_head": float(psnr(image, target, person).mean()),
        "ssim": float(ssim(image, target).mean()),
    }
    if lpips is not None:
        perceptual = lpips(image, target)
        values[f"lpips_{lpips.net}"] = None if perceptual is None else float(perceptual)
        if lpips.unavailable is not None:
            values["lpips_unavailable"] = lpips.unavailable
    return values
