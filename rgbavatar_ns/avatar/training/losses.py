"""Training losses: L1 over per-image random backgrounds, and LPIPS as an option."""

from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from rgbavatar_ns.drawing.compositing import film_over, is_unfilmed
from rgbavatar_ns.errors import UserError
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


def l1_loss(image: Float[Tensor, "B H W 3"], target: Float[Tensor, "B H W 3"]) -> Float[Tensor, ""]:
    """Return the mean absolute difference (paper, sec. 3.2)."""
    return F.l1_loss(image, target)


def image_losses(
    image: Float[Tensor, "B H W 3"],
    images_rgba: UInt8[Tensor, "B H W 4"] | Float[Tensor, "B H W 4"],
    background: Float[Tensor, "B 3"],
    lpips: "LPIPSLoss | None" = None,
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


class LPIPSLoss:
    """LPIPS between images in [0, 1], its network built on first use; gradients reach both.

    The network's weights come from the internet once (torchvision's VGG-16). Not a module, so
    that they never enter a checkpoint. Raises UserError where they cannot be had.
    """

    def __init__(self, net: Literal["vgg", "alex", "squeeze"] = "vgg") -> None:
        self.net: Literal["vgg", "alex", "squeeze"] = net
        self._network: nn.Module | None = None

    def __call__(
        self, image: Float[Tensor, "B H W 3"], target: Float[Tensor, "B H W 3"]
    ) -> Float[Tensor, ""]:
        """Return the mean over the batch."""
        network = self.network().to(image.device)
        first, second = (x.movedim(-1, 1).float() for x in (image, target))
        return network(first, second, normalize=True).mean()

    def network(self) -> nn.Module:
        """Return the network, building it the first time; raises UserError when it cannot be."""
        if self._network is None:
            self._network = _build_lpips_network(self.net)
        return self._network


def _build_lpips_network(net: Literal["vgg", "alex", "squeeze"]) -> nn.Module:
    """Build torchmetrics' LPIPS network; raises UserError with the reason where that fails."""
    try:
        # torchmetrics and torchvision take seconds to import, and are optional to a renderer.
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        metric = LearnedPerceptualImagePatchSimilarity(net_type=net)
    # Without a network, a disk or a working torchvision this fails in many ways.
    except Exception as error:
        raise UserError(
            f"LPIPS ({net}) is unavailable: {type(error).__name__}: {error}.",
            "Run once with internet access, or put torchvision's weights of the network into "
            f"{torch.hub.get_dir()}/checkpoints; or go on without LPIPS.",
        ) from error
    return metric.net.eval().requires_grad_(False)
