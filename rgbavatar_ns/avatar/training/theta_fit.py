"""Theta that fits an image, the avatar frozen: for frames that it has not seen."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.refinement.corrections import RefinementConfig, TrackingRefinement
from rgbavatar_ns.avatar.training.losses import image_losses, random_backgrounds, require_images_of
from rgbavatar_ns.kernels import PinholeCameras


def frame_gradients(
    avatar: AvatarMethod,
    theta: Float[Tensor, "B H"],
    cameras: PinholeCameras,
    images_rgba: UInt8[Tensor, "B H_px W_px 4"],
    background: Float[Tensor, "B 3"],
    backend: str = "auto",
) -> Float[Tensor, "B H"]:
    """The gradient of each frame's own L1 loss by its theta; the avatar stays as it is.

    Through autograd, but for an RGBAvatar whose backend can do without.
    """
    require_images_of(images_rgba, len(theta), cameras)
    theta = theta.detach().requires_grad_()
    with torch.enable_grad():
        if isinstance(avatar, Avatar):
            found = _without_autograd(avatar, theta, cameras, images_rgba, background, backend)
            if found is not None:
                return found
        drawn = avatar.render(theta, cameras, background, backend=backend, differentiable=True)
        loss = image_losses(drawn.image, images_rgba, background)["l1"]
        return torch.autograd.grad(loss * len(theta), theta)[0]


def _without_autograd(
    avatar: Avatar,
    theta: Float[Tensor, "B H"],
    cameras: PinholeCameras,
    images_rgba: UInt8[Tensor, "B H_px W_px 4"],
    background: Float[Tensor, "B 3"],
    backend: str,
) -> Float[Tensor, "B H"] | None:
    """Only mesh and weight network through autograd; None where no renderer can do the rest."""
    psi = avatar.weights(theta)
    vertices = avatar.carrier_vertices(theta.to(psi))
    renderer = avatar.renderer(theta, cameras, psi.detach(), vertices.detach(), backend=backend)
    if renderer is None:
        return None
    renderer.forward_loss(images_rgba, background)
    gradient = renderer.backward_adam(None, with_vertices=True)
    outputs, slopes = [vertices], [gradient.vertices]
    if psi.requires_grad:
        outputs.append(psi)
        slopes.append(gradient.weights)
    return len(theta) * torch.autograd.grad(outputs, theta, slopes)[0]


def fit_theta(
    avatar: AvatarMethod,
    theta: Float[Tensor, "B H"],
    cameras: PinholeCameras,
    images_rgba: UInt8[Tensor, "B H_px W_px 4"],
    steps: int,
    *,
    config: RefinementConfig | None = None,
    reference: Float[Tensor, "R H"] | None = None,
    backend: str = "auto",
) -> Float[Tensor, "B H"]:
    """Correct theta of unseen frames, the avatar frozen; `reference`: see `TrackingRefinement`.

    With such a `reference` a frame's theta is the same, whichever others are fitted beside it.
    """
    frames = TrackingRefinement(theta, avatar.layout, config, centered=False, reference=reference)
    rows = torch.arange(len(theta), device=theta.device)
    for step in range(steps):
        # One for all, so that a frame's place among them changes nothing.
        background = random_backgrounds(step, 1).to(theta).repeat(len(theta), 1)
        present = frames.theta()
        frames.step(
            rows, frame_gradients(avatar, present, cameras, images_rgba, background, backend)
        )
    return frames.theta()
