"""torch's Adam optimisers, whose state and learning rates steps without autograd use."""

from collections.abc import Iterable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.kernels import AdamParameter

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


class AdamStates:
    """Every parameter's next update; ValueError where `unsupported_reason` gives a reason."""

    def __init__(self, avatar: Avatar, optimizers: Iterable[torch.optim.Optimizer]) -> None:
        self.optimizers = list(optimizers)
        reason = unsupported_reason(avatar, self.optimizers)
        if reason is not None:
            raise ValueError(f"The fused step cannot be used: {reason}. Use the eager one.")
        self._homes = _homes(self.optimizers)
        groups = avatar.parameter_groups()
        self._gaussians = {n: groups[g][0] for n, g in _GROUPS.items() if g in groups}
        self._network = groups.get("weight_network", [])

    def next_of_gaussians(self) -> dict[str, AdamParameter]:
        """The next update of each of the Gaussians' tensors, by its name."""
        return {name: self._next(value) for name, value in self._gaussians.items()}

    def next_of_network(self) -> list[AdamParameter]:
        """The next update of each tensor of the weight network."""
        return [self._next(value) for value in self._network]

    def count_gaussians(self) -> None:
        """Count the step that the Gaussians' tensors have taken, in the optimisers' own states."""
        values = list(self._gaussians.values())
        _add_one(self._steps(values))
        self._recount(values)

    def add_one_to_all(self) -> None:
        """Count a step where the optimisers' states lie with what they train: recorded or not."""
        _add_one([step for value, step in self._all() if step.device == value.device])

    def recount_all(self) -> None:
        """Count a step of all on the host, after `add_one_to_all`, which may have been recorded.

        Adam that is neither fused nor capturable has its numbers here, which no recording counts.
        """
        _add_one([step for value, step in self._all() if step.device != value.device])
        self._recount([*self._gaussians.values(), *self._network])

    def _all(self) -> list[tuple[Tensor, Tensor]]:
        values = [*self._gaussians.values(), *self._network]
        return list(zip(values, self._steps(values)))

    def steps(self) -> list[Tensor]:
        """Where the optimisers' states count the steps of all tensors."""
        return self._steps([*self._gaussians.values(), *self._network])

    def _steps(self, values: Iterable[Tensor]) -> list[Tensor]:
        return [self._homes[value][0].state[value]["step"] for value in values]

    def _recount(self, values: Iterable[Tensor]) -> None:
        for value, step in zip(values, self._steps(values)):
            known = _COUNTS[self._homes[value][0]]
            known[value] = _Count(step, step._version, known[value].number + 1)

    def _next(self, value: Tensor) -> AdamParameter:
        optimizer, group = self._homes[value]
        state = optimizer.state[value]
        if not state:
            # As torch.optim.Adam begins, so that either path can go on from the other's state.
            place = value.device if group["fused"] or group["capturable"] else "cpu"
            state["step"] = torch.zeros((), dtype=torch.float32, device=place)
            state["exp_avg"] = torch.zeros_like(value)
            state["exp_avg_sq"] = torch.zeros_like(value)
        known, step = _COUNTS.setdefault(optimizer, {}), state["step"]
        count = known.get(value)
        if count is None or count.step is not step or count.version != step._version:
            # Others have counted, or a checkpoint was loaded: look, which waits for a device.
            count = known[value] = _Count(step, step._version, int(step))
        return AdamParameter(
            value=value,
            first_moment=state["exp_avg"],
            second_moment=state["exp_avg_sq"],
            learning_rate=float(group["lr"]),
            betas=(float(group["betas"][0]), float(group["betas"][1])),
            epsilon=float(group["eps"]),
            step=count.number + 1,
        )


@dataclass(frozen=True)
class _Count:
    """A state's tensor as it was when its number was last known."""

    step: Tensor
    version: int
    number: int


# Known numbers outlive the objects that count, as long as their optimiser lives.
_COUNTS: WeakKeyDictionary[torch.optim.Optimizer, dict[Tensor, _Count]] = WeakKeyDictionary()


def _add_one(steps: list[Tensor]) -> None:
    """In one launch for all of them."""
    if not steps:
        return
    torch._foreach_add_(steps, 1)  # pyright: ignore[reportPrivateImportUsage]


def unsupported_reason(avatar: Avatar, optimizers: Iterable[torch.optim.Optimizer]) -> str | None:
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


def take_steps(optimizers: Iterable[torch.optim.Optimizer]) -> None:
    """Step with each, and count their parameters as changed, which torch's fused ones do not.

    Copies that are kept for pictures (`model/kept_copy.py`) would stay what they were.
    """
    for optimizer in optimizers:
        optimizer.step()
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        increment_version([p for p in parameters if p.grad is not None])
