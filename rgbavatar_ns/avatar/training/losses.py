"""Training losses: L1 over per-image random backgrounds, and LPIPS as an option."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss, l1_loss
from rgbavatar_ns.drawing.compositing import film_over, is_unfilmed
from rgbavatar_ns.kernels import PinholeCameras


def require_images_of(images_rgba: Tensor, count: int, cameras: PinholeCameras) -> None:
    """Raise ValueError unless these are `count` RGBA images of the cameras' size."""
    wanted = (count, cameras.height, cameras.width, 4)
    if tuple(images_rgba.shape) != wanted:
        raise ValueError(f"The images are {tuple(images_rgba.shape)}. Pass {wanted}.")


def random_backgrounds(step: int, batch: int, seed: int = 0) -> Float[Tensor, "batch 3"]:
    """Return one random colour an image (paper, sec. 3.2), a pure function of the arguments."""
    counter = np.random.Philox(key=np.array([seed, step], dtype=np.uint64))
    return torch.from_numpy(np.random.Generator(counter).random((batch, 3), dtype=np.float32))


def image_losses(
    image: Float[Tensor, "B H W 3"],
    images_rgba: UInt8[Tensor, "B H W 4"] | Float[Tensor, "B H W 4"],
    background: Float[Tensor, "B 3"],
    lpips: LPIPSLoss | None = None,
    lpips_weight: float = 0.0,
) -> dict[str, Float[Tensor, ""]]:
    """ "l1" of drawn and filmed images over the same backgrounds; "lpips" times its weight.

    Pixels that nobody filmed add nothing and get no gradient; the mean is over all pixels, so that
    those that were filmed count as much as in any other image.
    """
    target = film_over(images_rgba, background, image.detach())
    losses = {"l1": l1_loss(image, target)}
    if lpips is not None:
        # The network sees around each pixel: what nobody filmed is the same in both, and fixed.
        seen = torch.where(is_unfilmed(images_rgba)[..., None], target, image)
        losses["lpips"] = lpips_weight * lpips(seen, target)
    return losses
