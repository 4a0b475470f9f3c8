"""What a step asks of the head and of theta, made once for all frames while theta stands still."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar

_FRAMES_AT_ONCE = 64


class FrameHeads:
    """The posed meshes of all frames, and what the weight network is told of them.

    A recorded step then gathers rows, where it would run some fifty small kernels. Made anew where
    theta, the person or the range of theta are others; 12 bytes a vertex and frame.
    """

    vertices: Float[Tensor, "F V 3"]
    features: Float[Tensor, "F _"]

    def __init__(self, avatar: Avatar) -> None:
        self._avatar = avatar
        self._made_of: list[tuple[Tensor, int]] = []

    @torch.no_grad()
    def know(self, theta: Float[Tensor, "F H"]) -> None:
        """Have `vertices` and `features` of these frames."""
        avatar = self._avatar
        person = avatar.head.remembered(avatar.identity)
        sources = [theta, *person, avatar.theta_low, avatar.theta_high]
        if len(sources) == len(self._made_of) and all(
            source is known and source._version == version
            for source, (known, version) in zip(sources, self._made_of)
        ):
            return
        parts = theta.split(_FRAMES_AT_ONCE)
        self.vertices = _joined(avatar.carrier_vertices(part) for part in parts)
        self.features = _joined(avatar.weight_features(part) for part in parts)
        self._made_of = [(source, source._version) for source in sources]


def _joined(parts: Iterable[Tensor]) -> Tensor:
    return torch.cat(list(parts)).contiguous()
