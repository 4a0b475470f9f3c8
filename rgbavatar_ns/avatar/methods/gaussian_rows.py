"""Tensors with a row for each Gaussian, changed together with what optimisers remember of them."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn

from rgbavatar_ns.errors import UserError, first_few

Optimizers = Iterable[torch.optim.Optimizer]


class GaussianRows:
    """The parameters and buffers of a module whose first axis is its N Gaussians.

    Parameters stay the objects that they are while N changes: only what they hold is replaced, and
    what optimisers remember of it, so that optimisers, schedulers and parameter groups stay valid.

    Args:
        module: owns the tensors.
        names: the tensors' names, dotted as in its `state_dict`; that of a submodule stands for all
            its tensors. ValueError where one is missing, or their first axes differ.
    """

    def __init__(self, module: nn.Module, names: Iterable[str]) -> None:
        self.module = module
        full_names = (full for name in names for full in _tensor_names(module, name))
        self.names = tuple(dict.fromkeys(full_names))
        self._require_equal({name: len(self[name]) for name in self.names})

    @property
    def count(self) -> int:
        """The number N of Gaussians."""
        return len(self[self.names[0]])

    def __getitem__(self, name: str) -> Tensor:
        """The tensor of this name as it is now."""
        owner, _, last = name.rpartition(".")
        return getattr(self.module.get_submodule(owner), last)

    @torch.no_grad()
    def take(
        self,
        source: Int[Tensor, "M"],
        optimizers: Optimizers,
        fresh: Bool[Tensor, "M"] | None = None,
    ) -> None:
        """Let row i become what row source[i] was, of every tensor and of the optimisers' states.

        In the states (Adam's moments) `fresh` rows begin with 0, as new Gaussians do in 3DGS
        (scene/gaussian_model.py). Gradients are dropped: they are of the rows of before.
        """
        optimizers, count = list(optimizers), self.count
        for name in self.names:
            value = self[name]
            for state in _states(value, optimizers):
                for key, entry in state.items():
                    if isinstance(entry, Tensor) and entry.ndim > 0 and len(entry) == count:
                        state[key] = entry[source]
                        if fresh is not None:
                            state[key][fresh] = 0
            self._replace(name, value.detach()[source])

    @torch.no_grad()
    def resize(self, count: int) -> None:
        """Make room for as many Gaussians, all zeros, before `load_state_dict` fills it.

        Optimisers' states stay as they are: they are loaded with theirs.
        """
        if count != self.count:
            for name in self.names:
                value = self[name].detach()
                self._replace(name, value.new_zeros(count, *value.shape[1:]))

    def fit_to(self, stored: Mapping[str, Any], prefix: str = "") -> None:
        """Make room for the Gaussians of a `state_dict`, whose names begin with `prefix`.

        UserError where one of the tensors is not there or has no row, where their rows differ in
        number, or are not of the size of a row here: so room is made for what is really stored.
        """
        kept = self.module.state_dict().keys()
        names = [name for name in self.names if name in kept]
        remedy = "Save the avatar again, or use another copy."
        missing = [name for name in names if not _has_rows(stored.get(prefix + name))]
        if missing:
            raise UserError(f"What was stored has no Gaussians' {first_few(missing)}.", remedy)
        other = [n for n in names if stored[prefix + n].shape[1:] != self[n].shape[1:]]
        if other:
            cause = f"Rows of Gaussians' {first_few(other)} are stored in another size"
            raise UserError(f"{cause} than the settings beside them make.", remedy)
        counts = {name: len(stored[prefix + name]) for name in names}
        try:
            self._require_equal(counts)
        except ValueError as error:
            raise UserError(str(error), remedy) from error
        self.resize(counts[names[0]])

    def _replace(self, name: str, value: Tensor) -> None:
        old = self[name]
        if not isinstance(old, nn.Parameter):
            owner, _, last = name.rpartition(".")
            setattr(self.module.get_submodule(owner), last, value)
            return
        old.grad = None
        # As long as a graph lives, that of the last loss for one, the parameter keeps its node in
        # it, which refuses gradients of another size. Data of another type makes torch drop it.
        other = torch.float16 if value.dtype != torch.float16 else torch.float32
        old.data = value.new_empty(0, dtype=other)
        old.data = value

    @staticmethod
    def _require_equal(counts: Mapping[str, int]) -> None:
        if len(set(counts.values())) != 1:
            told = [f"{name} has {count}" for name, count in counts.items()]
            raise ValueError(f"Rows of Gaussians differ in number: {first_few(told, 9)}.")


@torch.no_grad()
def forget_moments(
    parameter: nn.Parameter, optimizers: Optimizers, columns: slice = slice(None)
) -> None:
    """Zero what optimisers remember of a parameter's gradients; `columns` are of its last axis."""
    for state in _states(parameter, optimizers):
        for entry in state.values():
            if isinstance(entry, Tensor) and entry.shape == parameter.shape:
                entry[..., columns] = 0


def _states(value: Tensor, optimizers: Optimizers) -> Iterator[dict[str, Any]]:
    """The states that optimisers have for a parameter; an optimiser before its first has none."""
    for optimizer in optimizers:
        if value in optimizer.state:
            yield optimizer.state[value]


def _has_rows(value: object) -> bool:
    return isinstance(value, Tensor) and value.ndim > 0 and len(value) > 0


def _tensor_names(module: nn.Module, name: str) -> list[str]:
    """The tensor of this name, or all of the submodule of this name."""
    tensors = dict(module.named_parameters()) | dict(module.named_buffers())
    found = [full for full in tensors if full == name or full.startswith(f"{name}.")]
    if not found:
        raise ValueError(f"The module has no {name}. It has {first_few(tensors, 20)}.")
    return found
