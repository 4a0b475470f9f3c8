"""The optimiser step without autograd, for what the eager step spends its time on.

Morphing, tangent frames, rasterisation, L1 and Adam of all Gaussian parameters run in the backend's
own loops; torch keeps the weight network. Agrees with the eager step up to rounding.
"""

from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.training.losses import require_images_of
from rgbavatar_ns.avatar.training.optimizer_states import AdamStates, take_steps
from rgbavatar_ns.kernels import FirstSight, MorphedGradient, MorphedRenderer, PinholeCameras


class FusedStep:
    """Trains with torch's Adam optimisers; ValueError where `unsupported_reason` has a reason."""

    def __init__(
        self, avatar: Avatar, optimizers: Iterable[torch.optim.Optimizer], backend: str = "auto"
    ) -> None:
        self._avatar, self._states = avatar, AdamStates(avatar, optimizers)
        self._backend = backend

    def __call__(
        self,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        images_rgba: UInt8[Tensor, "B H_px W_px 4"],
        background: Float[Tensor, "B 3"],
        before_loss: Callable[[MorphedRenderer], UInt8[Tensor, "B H_px W_px 4"]] | None = None,
        sight: FirstSight | None = None,
    ) -> Float[Tensor, ""]:
        """Take one step and return the loss; `sight`, where given, is filled.

        `before_loss`, where given, looks at what is about to be drawn and returns the images.
        Where theta requires a gradient, `theta.grad` gets that of the loss before the step, as
        from `backward`. Raises ValueError where the images are not of the cameras' size or not as
        many as theta, or the backend has no step without autograd.
        """
        # Compiled code reads what it is promised.
        require_images_of(images_rgba, len(theta), cameras)
        background = background.expand(len(theta), 3)
        psi = self._avatar.weights(theta)
        with torch.set_grad_enabled(theta.requires_grad):
            vertices = self._avatar.carrier_vertices(theta.to(psi))
        renderer = self._avatar.renderer(
            theta, cameras, psi.detach(), vertices, backend=self._backend
        )
        if renderer is None:
            raise ValueError("This backend's steps go through autograd. Use the eager step.")
        if before_loss is not None:
            images_rgba = before_loss(renderer)
        loss = renderer.forward_loss(images_rgba, background, sight)
        gradient = self.update_gaussians(renderer, with_vertices=theta.requires_grad)
        self.update_network(psi, gradient.weights)
        if gradient.vertices is not None:
            vertices.backward(gradient.vertices)
        return loss

    def update_gaussians(
        self, renderer: MorphedRenderer, *, with_vertices: bool = False
    ) -> MorphedGradient:
        """Step by the renderer's last forward_loss and return the gradient of what posed it."""
        parameters = self._states.next_of_gaussians()
        gradient = renderer.backward_adam(parameters, with_vertices=with_vertices)
        self._states.count_gaussians()
        return gradient

    def update_network(
        self, psi: Float[Tensor, "B K"], weight_gradient: Float[Tensor, "B K"]
    ) -> None:
        """Step with the weight network that gave psi."""
        for optimizer in self._states.optimizers:
            optimizer.zero_grad(set_to_none=True)
        if psi.requires_grad:
            psi.backward(weight_gradient)
        # Of the Gaussians they find no gradient; hooks and schedules still see each take its step.
        take_steps(self._states.optimizers)


def probed_renderer(avatar: Avatar, backend: str) -> MorphedRenderer | None:
    """How the backend draws this avatar without autograd, tried on a tiny image."""
    position = avatar.blendshapes.position
    camera = PinholeCameras(
        torch.eye(4).to(position)[None],
        position.new_full((1, 2), 8.0),
        position.new_full((1, 2), 8.0),
        width=16,
        height=16,
    )
    return avatar.renderer(position.new_zeros(1, avatar.layout.size), camera, backend=backend)
