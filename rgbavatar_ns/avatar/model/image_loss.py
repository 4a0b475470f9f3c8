"""How far pictures are apart, for training: L1, and LPIPS, whose network is built when needed."""

from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from rgbavatar_ns.errors import UserError


def l1_loss(image: Float[Tensor, "B H W 3"], target: Float[Tensor, "B H W 3"]) -> Float[Tensor, ""]:
    """Return the mean absolute difference (paper, sec. 3.2)."""
    return F.l1_loss(image, target)


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
