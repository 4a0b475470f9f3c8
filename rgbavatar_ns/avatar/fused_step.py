"""The optimiser step without autograd, for what the eager step spends its time on.

Blending, tangent frames, rasterisation, L1 and Adam of all Gaussian parameters run in the backend's
own loops; torch keeps the weight network. Agrees with `training_step`'s eager path up to rounding.
"""

from collections.abc import Iterable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.losses import require_images_of
from rgbavatar_ns.kernels import (
    AdamParameter,
    BlendedGradient,
    BlendedRenderer,
    PinholeCameras,
)

_GROUPS = {
    "position": "position",
    "rotation_wxyz": "rotation",
    "color_feature": "color",
    "log_scale": "log_scale",
    "opacity_logit": "opacity",
    "basis_position": "basis_position",
    "basis_rotation_wxyz": "basis_rotation",
    "basis_color_feature": "basis_color",
}
"""The parameter group of each of the Gaussians' tensors."""

_PLAIN_ADAM = {"weight_decay": 0, "amsgrad": False, "maximize": False, "differentiable": False}


class FusedStep:
    """Trains an avatar with torch's Adam optimisers, whose state and learning rates it uses.

    The optimisers' checkpoints are those of the eager path: a run can change between the two.

    Raises:
        ValueError: `refusal` gives a reason for these optimisers.
    """

    def __init__(self, avatar: Avatar, optimizers: Iterable[torch.optim.Optimizer]) -> None:
        self._avatar, self._optimizers = avatar, list(optimizers)
        reason = refusal(avatar, self._optimizers)
        if reason is not None:
            raise ValueError(f"The fused step cannot be used: {reason}. Use the eager one.")
        homes = _homes(self._optimizers)
        groups = avatar.parameter_groups()
        self._parameters = {
            name: (groups[group][0], *homes[groups[group][0]])
            for name, group in _GROUPS.items()
            if group in groups
        }

    def __call__(
        self,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        images_rgba: UInt8[Tensor, "B H_px W_px 4"],
        background: Float[Tensor, "B 3"],
        backend: str = "auto",
    ) -> Float[Tensor, ""] | None:
        """Take one step and return the loss; None, and no step, where the backend cannot.

        Where theta requires a gradient, `theta.grad` gets that of the loss before the step, as
        from `backward`. Raises ValueError where the images are not of the cameras' size, or not as
        many as theta.
        """
        # Compiled code reads what it is promised.
        require_images_of(images_rgba, len(theta), cameras)
        background = background.expand(len(theta), 3)
        psi = self._avatar.weights(theta)
        with torch.set_grad_enabled(theta.requires_grad):
            vertices = self._avatar.carrier_vertices(theta.to(psi))
        renderer = self._avatar.renderer(theta, cameras, psi.detach(), vertices, backend=backend)
        if renderer is None:
            return None
        loss = renderer.compare(images_rgba, background)
        gradient = self.update_gaussians(renderer, with_vertices=theta.requires_grad)
        self.update_network(psi, gradient.weights)
        if gradient.vertices is not None:
            vertices.backward(gradient.vertices)
        return loss

    def update_gaussians(
        self, renderer: BlendedRenderer, *, with_vertices: bool = False
    ) -> BlendedGradient:
        """Step by the renderer's last comparison and return the gradient of what posed it."""
        parameters = {name: self._adam(name) for name in self._parameters}
        return renderer.update(parameters, with_vertices=with_vertices)

    def update_network(
        self, psi: Float[Tensor, "B K"], weight_gradient: Float[Tensor, "B K"]
    ) -> None:
        """Step with the weight network that gave psi."""
        for optimizer in self._optimizers:
            optimizer.zero_grad(set_to_none=True)
        if psi.requires_grad:
            psi.backward(weight_gradient)
        # Of the Gaussians they find no gradient; hooks and schedules still see each take its step.
        for optimizer in self._optimizers:
            optimizer.step()

    def _adam(self, name: str) -> AdamParameter:
        """The parameter's next update; counts it."""
        value, optimizer, group = self._parameters[name]
        state = optimizer.state[value]
        if not state:
            # As torch.optim.Adam begins, so that either path can go on from the other's state.
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"] = torch.zeros_like(value)
            state["exp_avg_sq"] = torch.zeros_like(value)
        state["step"] += 1
        return AdamParameter(
            value=value,
            first_moment=state["exp_avg"],
            second_moment=state["exp_avg_sq"],
            learning_rate=float(group["lr"]),
            betas=(float(group["betas"][0]), float(group["betas"][1])),
            epsilon=float(group["eps"]),
            step=int(state["step"]),
        )


def refusal(avatar: Avatar, optimizers: Iterable[torch.optim.Optimizer]) -> str | None:
    """Return why the fused step cannot train this avatar with these optimisers; None if it can."""
    homes = _homes(optimizers)
    for name, parameters in avatar.parameter_groups().items():
        for parameter in parameters:
            if parameter not in homes:
                return f"no optimiser holds the parameters of {name}"
            optimizer, group = homes[parameter]
            if type(optimizer) is not torch.optim.Adam:
                return f"the optimiser of {name} is {type(optimizer).__name__}, not Adam"
            for option, plain in _PLAIN_ADAM.items():
                if group[option] != plain:
                    return f"the optimiser of {name} has {option}={group[option]}"
            if not parameter.is_contiguous():
                return f"the parameters of {name} are not contiguous"
    return None


def _homes(
    optimizers: Iterable[torch.optim.Optimizer],
) -> dict[Tensor, tuple[torch.optim.Optimizer, dict]]:
    """Each parameter's optimiser and group."""
    return {p: (o, g) for o in optimizers for g in o.param_groups for p in g["params"]}
