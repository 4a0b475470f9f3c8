"""What theta does before Gaussians are drawn, weights and posed mesh, without tensor operations.

The readable path is the head model and the weight network in torch; this one gives the same numbers
to 1e-5 for one theta, without gradients.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class PosingParameters:
    """A mesh of shape directions and five joints, and a network that reads the same theta.

    Slices and starts are places in theta [H]. The root comes first, each joint after its parent.
    """

    rest: Float[Tensor, "3 V"]
    directions: Float[Tensor, "R V3"]
    """Of expressions, eyelids, and correctives: of R - I of all joints but the root, row by row."""
    joints: Float[Tensor, "3 5"]
    joint_directions: Float[Tensor, "E 15"]
    skinning: Float[Tensor, "5 V"]
    parents: tuple[int, ...]
    expression: slice
    eyelids: slice
    translation: slice
    turns: tuple[int, ...]
    """Where each joint's axis-angle vector starts."""
    by_joints_alone: bool
    """Whether expressions and eyelids move no vertex."""
    low: Float[Tensor, " H"]
    high: Float[Tensor, " H"]
    """What training saw of each number; nothing where they cross."""
    features: tuple[tuple[slice, bool], ...]
    """What the network reads; True where a turn is read as the first two rows of its matrix."""
    layers: tuple[tuple[Float[Tensor, "_ _"], Float[Tensor, " _"]], ...]
    """Weight and bias, with ReLU between them; none: weights are the features."""


@runtime_checkable
class Posing(Protocol):
    """A copy of `PosingParameters` for one theta after another."""

    def __call__(
        self, theta: Float[Tensor, "1 H"]
    ) -> tuple[Float[Tensor, "1 K"], Float[Tensor, "1 V 3"]]:
        """Weights psi, and vertices in metres; raises ValueError for a theta of another size."""
        ...
