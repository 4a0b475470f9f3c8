"""Performances to pictures: any background, or none with the alpha kept."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.drawing.compositing import straight_alpha, to_uint8
from rgbavatar_ns.kernels import PinholeCameras, RenderedBatch

Picture = UInt8[np.ndarray, "height width channels"]
"""RGB, or RGBA with straight alpha."""
Color = tuple[float, float, float]

_BATCH = 8


@torch.no_grad()
def draw(
    avatar: AvatarMethod,
    theta: Float[Tensor, "B H"],
    cameras: PinholeCameras,
    background: Color | None = None,
    psi: Float[Tensor, "B K"] | None = None,
    *,
    to_be_seen: bool = False,
) -> RenderedBatch:
    """Draw a batch, without gradients; other options are those of `AvatarMethod.render`."""
    like = avatar.identity
    theta = theta.to(like)
    ground = like.new_tensor((0.0, 0.0, 0.0) if background is None else background)
    weights = None if psi is None else psi.to(like)
    return avatar.render(theta, cameras, ground, psi=weights, to_be_seen=to_be_seen)


def pictures(
    avatar: AvatarMethod,
    theta: Float[Tensor, "F H"],
    cameras: PinholeCameras,
    background: Color | None,
    psi: Float[Tensor, "F K"] | None = None,
) -> Iterator[Picture]:
    """A picture for each frame: RGB over the background, or RGBA where there is none.

    cameras: one for all frames, or one for each.
    """
    for start in range(0, len(theta), _BATCH):
        places = list(range(start, min(start + _BATCH, len(theta))))
        several = len(cameras.world_to_camera) > 1
        seen_by = cameras.select(places) if several else cameras
        weights = None if psi is None else psi[places]
        rendered = draw(avatar, theta[places], seen_by, background, weights)
        for image, alpha in zip(rendered.image, rendered.alpha):
            yield to_uint8(image if background is not None else straight_alpha(image, alpha))
