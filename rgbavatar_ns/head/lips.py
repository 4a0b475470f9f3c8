"""How far a head's lips are apart, whatever opens them."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.flame import FLAME_VERTICES
from rgbavatar_ns.head.landmarks import facemesh_landmarks
from rgbavatar_ns.head.layout import RIGID_FIELDS
from rgbavatar_ns.head.model import HeadModel
from rgbavatar_ns.head.teeth import LOWER_LIP, UPPER_LIP

_INNER_UPPER, _INNER_LOWER = 13, 14
"""FaceMesh's points in the middle of the lips' inner rims."""
_JAW_STEP_RAD = 0.05


class LipGap:
    """The distance of the lips' middles along the face's height, metres; below 0 they overlap.

    Known of the embedded heads and of FLAME's vertices; `of` gives None for others.
    """

    def __init__(
        self,
        head: HeadModel,
        identity: Float[Tensor, "I"],
        vertices: Int[np.ndarray, "2 K"],
        weights: Float[np.ndarray, "2 K"],
    ) -> None:
        self._head, self._identity = head, identity
        self._vertices = torch.from_numpy(vertices.astype(np.int64)).flatten()
        self._weights = torch.from_numpy(weights).to(identity)
        self._moves = torch.ones(head.layout.size)
        for name in RIGID_FIELDS:
            self._moves[head.layout.slice(name)] = 0
        self.jaw = head.layout.slice("jaw").start
        two = torch.zeros(2, head.layout.size)
        two[1, self.jaw] = _JAW_STEP_RAD
        closed, opened = self(two).tolist()
        self.at_rest_m = closed
        self.slope_m_per_rad = (opened - closed) / _JAW_STEP_RAD

    @classmethod
    def of(cls, head: HeadModel, identity: Float[Tensor, "I"]) -> "LipGap | None":
        """The gap of a person's lips, if it is known where this head has them."""
        found = _lips(head.arrays)
        return None if found is None else cls(head, identity, *found)

    @torch.no_grad()
    def __call__(self, theta: Float[Tensor, "F H"]) -> Float[Tensor, "F"]:
        """The gap of each theta."""
        still = (theta * self._moves).to(self._identity)
        heights = self._head(still, self._identity, self._vertices)[..., 1]
        upper, lower = (heights.unflatten(1, (2, -1)) * self._weights).sum(-1).unbind(1)
        return upper - lower


def _lips(arrays: HeadArrays) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices and weights of the upper and the lower lip's middle."""
    if HeadArrays.embedded_as(arrays.name) is not None:
        marks = facemesh_landmarks()
        rows = [
            int(np.flatnonzero(marks.facemesh_index == index)[0])
            for index in (_INNER_UPPER, _INNER_LOWER)
        ]
        return arrays.faces[marks.triangle[rows]], marks.barycentric[rows]
    if len(arrays.v_template) >= FLAME_VERTICES and not arrays.expression_names[0].isalpha():
        middle = len(UPPER_LIP) // 2
        return np.array([[UPPER_LIP[middle]], [LOWER_LIP[middle]]]), np.ones((2, 1))
    return None
