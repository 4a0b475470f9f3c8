"""What is done with tiles' lists, for world-space and for morphed Gaussians alike."""

from typing import Any

import torch
from torch import Tensor

from rgbavatar_ns.kernels.cuda.binning import Bins, blocks
from rgbavatar_ns.kernels.cuda.launcher import Launcher
from rgbavatar_ns.kernels.cuda.source import constants
from rgbavatar_ns.kernels.types import FirstSight

_PIXEL_BYTES = 4


class Tiles:
    """Draws, averages and differentiates a batch that was projected into `bins`."""

    def __init__(self, launcher: Launcher, bins: Bins) -> None:
        self._launcher, self.bins = launcher, bins

    def _launch(self, kernel: str, **values: Any) -> None:
        shared = {"frame": self.bins.images.values(), "bins": self.bins.values()}
        self._launcher.launch(kernel, self.bins.tile_grid, **shared, **values)

    def _new(self, *shape: int) -> Tensor:
        return torch.empty(shape, device=self._launcher.device)

    def draw(
        self, background: Tensor, *, with_depth: bool, checked: bool = True
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Image, alpha and depth; where it is `checked`, waits for the lists' length."""
        self.bins.sort(checked=checked)
        images = self.bins.images
        size = (images.batch, images.height, images.width)
        image, alpha = self._new(*size, 3), self._new(*size, 1)
        depth = self._new(*size, 1) if with_depth else None
        self._launch(
            "draw",
            background=background.contiguous(),
            background_shared=int(len(background) == 1),
            image=image,
            alpha=alpha,
            depth=depth,
        )
        return image, alpha, depth

    def average(self, images: Tensor | None) -> tuple[Tensor | None, Tensor, Tensor]:
        """Sums of w I and w, and the largest w, by Gaussian."""
        self.bins.sort(checked=True)
        batch, count = self.bins.images.batch, self.bins.images.count
        channels = 0 if images is None else images.shape[-1]
        slots = self._new(self.bins.capacity, channels + 2)
        self._launch(
            "average",
            images=images,
            images_shared=int(images is not None and len(images) == 1),
            channels=channels,
            slots=slots,
        )
        weighted_sum = None if images is None else self._new(batch, count, channels)
        weight_sum, max_weight = self._new(batch, count), self._new(batch, count)
        self._launcher.launch(
            "collect",
            (blocks(count, "kBlendThreads"), batch),
            frame=self.bins.images.values(),
            bins=self.bins.values(),
            slots=slots,
            channels=channels,
            weighted_sum=weighted_sum,
            weight_sum=weight_sum,
            max_weight=max_weight,
        )
        return weighted_sum, weight_sum, max_weight

    def _new_slots(self) -> Tensor:
        return self._new(self.bins.capacity, constants()["kMoments"])

    def differentiate(
        self, image: Tensor, alpha: Tensor, image_grad: Tensor | None, alpha_grad: Tensor | None
    ) -> Tensor:
        """The slots' moments, from the gradients of what was drawn."""
        slots = self._new_slots()
        self._launch(
            "differentiate",
            image=image,
            alpha=alpha,
            image_gradient=image_grad,
            alpha_gradient=alpha_grad,
            slots=slots,
        )
        return slots

    def train(
        self,
        images_rgba: Tensor,
        image_of: Tensor | None,
        background: Tensor,
        sight: FirstSight | None,
    ) -> tuple[Tensor, Tensor]:
        """The mean absolute difference to the images, and the slots' moments; waits for nothing."""
        self.bins.sort(checked=False)
        if images_rgba.data_ptr() % _PIXEL_BYTES:  # pixels are read whole
            images_rgba = images_rgba.clone()
        size = self.bins.images
        each = 1.0 / (size.batch * size.width * size.height * 3)
        slots, loss = self._new_slots(), self._new(size.batch, size.tiles)
        self._launch(
            "train",
            images=images_rgba,
            image_of=image_of,
            background=background.contiguous(),
            background_shared=int(len(background) == 1),
            gradient=each,
            slots=slots,
            loss=loss,
            known=None if sight is None else sight.known.view(torch.uint8),
            sight=None if sight is None else sight.sums,
            sight_images=0 if sight is None else sight.num_images,
            over_background=int(sight is not None and sight.over_background),
        )
        return loss.sum(dtype=torch.float64).float() * each, slots
