"""The compiled way from theta to weights and a posed mesh."""

import os

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.cpu import (
    INSTRUCTION_SET_VARIABLE,
    _native,  # pyright: ignore[reportMissingModuleSource]
)
from rgbavatar_ns.kernels.posing import PosingParameters


class CpuPosing:
    """See `kernels.posing.Posing`."""

    def __init__(self, parameters: PosingParameters) -> None:
        p = parameters
        expression, eyelids = p.expression, p.eyelids
        self._theta_size = len(p.low)
        self._posing = _native.Posing(
            (
                len(p.low),
                expression.start,
                expression.stop - expression.start,
                eyelids.start,
                eyelids.stop - eyelids.start,
                p.translation.start,
            ),
            p.turns,
            p.parents,
            _plain(p.rest),
            _plain(p.directions),
            _plain(p.joints),
            _plain(p.joint_directions),
            _plain(p.skinning),
            p.by_joints_alone,
            _plain(p.low),
            _plain(p.high),
            [(part.start, part.stop - part.start, turn) for part, turn in p.features],
            [(_plain(weight), _plain(bias)) for weight, bias in p.layers],
        )

    def __call__(
        self, theta: Float[Tensor, "1 H"]
    ) -> tuple[Float[Tensor, "1 K"], Float[Tensor, "1 V 3"]]:
        """See `kernels.posing.Posing`; raises ValueError for a theta of another size."""
        if theta.shape != (1, self._theta_size):
            raise ValueError(f"theta is {list(theta.shape)}. Pass [1, {self._theta_size}].")
        weights = theta.new_empty(1, self._posing.num_weights)
        vertices = theta.new_empty(1, self._posing.num_vertices, 3)
        instruction_set = os.environ.get(INSTRUCTION_SET_VARIABLE, "")
        threads = torch.get_num_threads()
        self._posing.run(_plain(theta), weights, vertices, threads, instruction_set)
        return weights, vertices


def _plain(tensor: Tensor) -> Tensor:
    return tensor.detach().contiguous()
